"""`RosbridgeServer`: to web pages, a bus looks like ROS behind a rosbridge server with a tf2_web_republisher.

Each page is one `_Page`, which owns the work that the page asked for, and ends it when the page goes. One task reads
its requests, another writes messages, so that a message leaves whole even if its subscription ends meanwhile.
Every subscription and every republication is a task of its own between the two. It hands over one message at a time,
and takes the newest state of the bus when the page has read that one: a slow page skips, and nobody waits for it.

A republication is some frames in a fixed frame, at a rate, with thresholds. There are three ways to ask for it, and all
of them come to `_Page._republish`:

* the action of ROS 1: a goal is a message on ``/tf2_web_republisher/goal``, its feedback comes on ``…/feedback``;
* the service of ROS 1, ``/republish_tfs``: it names a topic, and the republication lasts while that is subscribed to;
* the action of ROS 2, for which rosbridge has operations.

A `Watch` for each frame tells when it has changed. After each message the republication pauses for a period. Then all
watches that have changed are read at once, so that their answers are new and go into one message.

Stamps have the names of their fields in ROS 1 and in ROS 2, for a page does not say which of them it expects.
"""

import json
from collections.abc import Awaitable, Callable, Iterable, Sequence
from contextlib import ExitStack, suppress
from functools import partial
from itertools import count
from math import pi
from typing import Any, Final, NamedTuple

import anyio
import anyio.abc
import anyio.lowlevel
import cbor2

from tfbus._aio.web_site import WebFile, WebSite
from tfbus._aio.websocket import WebSocket
from tfbus.buffer.buffer import Buffer
from tfbus.buffer.watch import Watch
from tfbus.bus.bus import Bus
from tfbus.bus.queues import Stream
from tfbus.errors import BusClosedError, ClockResetError, TransformLookupError
from tfbus.geometry.stamped import TransformStamped
from tfbus.links.bus_server import BusServer
from tfbus.links.ros.messages import as_mapping, decode_mapping
from tfbus.stamps import LATEST, SECOND
from tfbus.tf_message import MalformedMessageError, encode, refusal

MAX_REQUEST: Final = 2**18
"""The longest request of a page, in characters."""
MOST_FRAMES: Final = 1_000
"""The most frames that a page may have republished, and may publish."""
MOST_REQUESTS: Final = 100
"""The most subscriptions to a topic of a page, and the most topics that the service has named for it."""
MOST_WAITING: Final = 1_000
"""The most samples that wait for a page on a topic; then the oldest are dropped."""
MOST_CONFLATED: Final = 10_000
"""The most frames whose newest samples wait for a page that has a throttle rate."""
MOST_AT_ONCE: Final = 100
"""The most transforms of one message."""
LONGEST_ERROR: Final = 1_000
"""The longest text of a status, in characters."""
HIGHEST_RATE: Final = 100.0
"""Hz; a page that asks for more gets this."""
_LONGEST_PERIOD: Final = 3_600.0
"""s."""
_LARGEST_NUMBER: Final = 1e9

_TOPICS: Final = {"/tf": False, "/tf_static": True}
"""Whether a topic is of static frames."""
_REPUBLISHER: Final = "/tf2_web_republisher"
_GOAL, _CANCEL, _FEEDBACK = (f"{_REPUBLISHER}/{name}" for name in ("goal", "cancel", "feedback"))
_SERVICE: Final = "/republish_tfs"
_CANCELED, _ABORTED = 5, 6
"""Of action_msgs/GoalStatus."""
_ACTIVE: Final = 1
"""Of actionlib_msgs/GoalStatus."""
_LEVELS: Final = ("none", "error", "warning", "info")
_COMPRESSIONS: Final = ("none", "cbor", "cbor-raw")
_TURNS: Final = 3
"""In so many turns of the event loop, a watch that was told to go on has given its answer."""


class RosbridgeServer(BusServer):
    """Serves a bus to web pages with roslib, unmodified: ``async with RosbridgeServer(bus) as server``.

    It is to a page what a rosbridge server beside ROS 1 or ROS 2 is: the page subscribes to ``/tf`` and ``/tf_static``,
    and the ``TFClient`` and ``ROS2TFClient`` of roslib, and with them ros3d, find a tf2_web_republisher. Other programs
    that speak rosbridge may connect too, such as a `RosbridgeLink`.

    Parameters
    ----------
    bus : Bus
    port : int
        The port to listen at; 0 for any.
    buffer : Buffer, optional
        The buffer of the bus that answers the clients of tf. By default, it is one of the server's own, which knows of
        static frames, and of what moves from then on.
    host : str
        The address to listen at; by default, only programs on this machine can connect.
    origins : iterable of str
        The web pages of other servers that may connect, such as ``http://localhost:8000``; ``*`` is for all. By default
        only its own page may. A program that is no browser sends no origin, and may connect.
    publish : bool
        Whether pages may publish on ``/tf`` and ``/tf_static``, with the authority ``"rosbridge"``.
    page : str, optional
        A web page in HTML that is served at the same address, ``http://127.0.0.1:9090/``.

    Attributes
    ----------
    address : str
        The address for roslib, ``ws://127.0.0.1:9090``; empty outside of the ``async with``.
    sent : int
        Transforms that were sent.
    dropped : int
        Samples that were not sent to a page that had subscribed to their topic, because it was too slow.
    refused : int
        Connections that were refused: of other pages, or beyond the 100th.
    requests_refused : int
        Requests of pages that were not carried out. The page is told why: by a status, which roslib emits as the event
        ``"status"``, or by the failure of its service or action.

    Raises
    ------
    ValueError
        If the port is out of range, an origin has not the form of one, or the buffer belongs to another bus.
    OSError
        On entering, if the address cannot be listened at.
    BusClosedError, RuntimeError
        On entering, if the bus is closed; if it belongs to another thread, or the server was entered before.

    Notes
    -----
    A subscription gets each batch of the bus as a message. With a ``throttle_rate``, it gets one message in so many ms,
    with the newest sample of each frame; with a ``queue_length`` as well, so many samples that wait for it are kept.
    The ``compression`` may be ``cbor``, or ``cbor-raw`` for bytes of ROS 2 on ``/tf`` and ``/tf_static``. PNG and
    fragments are not offered: a page that asks for them gets whole messages in JSON, and a warning as its status.

    A page whose connection breaks has to ask again: ``ros.on("connection", () => client.updateGoal())``.
    """

    def __init__(
        self,
        bus: Bus,
        port: int = 9090,
        *,
        buffer: Buffer | None = None,
        host: str = "127.0.0.1",
        origins: Iterable[str] = (),
        publish: bool = False,
        page: str | None = None,
    ) -> None:
        if buffer is not None and buffer.bus is not bus:
            raise ValueError("the buffer belongs to another bus")
        text = "this is a rosbridge: connect with roslib\n" if page is None else page
        file = WebFile(f"text/{'plain' if page is None else 'html'}; charset=utf-8", text.encode())
        # A page of the user loads what it wants; only pages of other servers may not hide it in theirs.
        site = WebSite({"/": file}, self._talk, MAX_REQUEST, policy="frame-ancestors 'self'")
        super().__init__(bus, host, port, origins, site.answer)
        self._may_publish: bool = publish
        self.sent: int = 0
        self._streams: set[Stream] = set()
        self._dropped: int = 0
        self.requests_refused: int = 0
        self._given = buffer
        self._buffer: Buffer

    @property
    def dropped(self) -> int:
        """Samples that were not sent, because a page was too slow."""
        return self._dropped + sum(stream.dropped for stream in self._streams)

    async def _open(self) -> None:
        self._buffer = Buffer(self.bus) if self._given is None else self._given

    async def _close(self) -> None:
        if self._given is None:
            self._buffer.close()

    async def _talk(self, socket: WebSocket) -> None:
        await _Page(self, socket).run()


class _RefusedRequest(ValueError):
    """A request that cannot be carried out, with what to tell the page."""


class _Republication(NamedTuple):
    """The frames that a page wants to have republished.

    Attributes
    ----------
    target : str
    sources : tuple of str
    min_translation, min_rotation : float
        Thresholds in m and rad, as for `Buffer.watch`.
    period : float
        The least time between two messages, in s.
    """

    target: str
    sources: tuple[str, ...]
    min_translation: float
    min_rotation: float
    period: float


Say = Callable[[Sequence[TransformStamped]], Awaitable[None]]


class _Subscription(NamedTuple):
    """A subscription.

    Attributes
    ----------
    name : str
        The topic as the page calls it, with a leading slash or without.
    period : float
        The least time between two messages, in s.
    length : int
        How many samples may wait for that; 0 for the newest of each frame.
    compression : {"none", "cbor", "cbor-raw"}
    """

    name: str
    period: float
    length: int
    compression: str


class _Page:
    """One connection."""

    def __init__(self, server: RosbridgeServer, socket: WebSocket) -> None:
        self._server = server
        self._socket = socket
        self._level = _LEVELS.index("warning")
        self._subscriptions: dict[str, dict[str | int | None, _Subscription]] = {}
        self._named: dict[str, _Republication] = {}
        self._names = count()
        self._published: set[str] = set()
        # A page whose connection broke may send its goal before it subscribes to the feedback.
        self._hears_feedback = anyio.Event()
        # Work by its topic, or by the name of its goal, and the number of frames that it republishes.
        self._scopes: dict[str, tuple[anyio.CancelScope, int]] = {}
        self._out, self._outgoing = anyio.create_memory_object_stream[str | bytes](0)
        self._tasks: anyio.abc.TaskGroup
        self._operations: dict[str, Callable[[dict[str, Any]], Awaitable[None]]] = {
            "subscribe": self._subscribe,
            "unsubscribe": self._unsubscribe,
            "advertise": self._advertise,
            "unadvertise": self._unadvertise,
            "publish": self._publish,
            "call_service": self._call_service,
            "send_action_goal": self._send_goal,
            "cancel_action_goal": self._cancel_goal,
            "set_level": self._set_level,
        }

    async def run(self) -> None:
        """Talk with the page until it has gone."""
        with self._out, self._outgoing:
            async with anyio.create_task_group() as self._tasks:
                self._tasks.start_soon(self._write)
                with suppress(OSError):
                    while True:
                        await self._answer(await self._socket.receive())
                self._tasks.cancel_scope.cancel()

    async def _write(self) -> None:
        with suppress(OSError):
            async for message in self._outgoing:
                await self._socket.send(message)
        self._tasks.cancel_scope.cancel()

    async def _send(self, message: dict[str, Any]) -> None:
        await self._out.send(json.dumps(message))

    async def _send_message(self, topic: str, message: dict[str, Any], transforms: Sequence[TransformStamped]) -> None:
        """Send a message of some transforms to the subscriptions of a topic."""
        subscriptions = list(self._subscriptions.get(topic, {}).values())
        for name in dict.fromkeys(subscription.name for subscription in subscriptions):
            envelope = {"op": "publish", "topic": name, "msg": message}
            compression = max((subscription.compression for subscription in subscriptions), key=_COMPRESSIONS.index)
            if compression == "none":
                await self._send(envelope)
                continue
            if compression == "cbor-raw":
                seconds, nanoseconds = divmod(self._server.bus.clock.now(), SECOND)
                held = [transform for transform in transforms if refusal(transform) is None]
                envelope["msg"] = {"secs": seconds, "nsecs": nanoseconds, "bytes": encode(held)}
            try:
                data = cbor2.dumps(envelope)
            except UnicodeEncodeError:
                # A name with half of a surrogate pair, which only JSON can write.
                await self._send(envelope)
            else:
                await self._out.send(data)

    async def _send_transforms(self, topic: str, transforms: Sequence[TransformStamped]) -> None:
        await self._send_message(topic, _message(transforms), transforms)

    async def _say_all(self, transforms: Sequence[TransformStamped], say: Say) -> None:
        """Send some transforms in messages of `MOST_AT_ONCE`."""
        for first in range(0, len(transforms), MOST_AT_ONCE):
            part = transforms[first : first + MOST_AT_ONCE]
            await say(part)
            self._server.sent += len(part)

    # Requests

    async def _answer(self, text: str | bytes) -> None:
        request: dict[str, Any] = {}
        try:
            request = _request_of(text)
            operation = self._operations.get(_text(request, "op"))
            if operation is None:
                raise _RefusedRequest(f"there is no operation {request['op']!r} here")
            await operation(request)
        except (_RefusedRequest, BusClosedError) as error:
            self._server.requests_refused += 1
            await self._refuse(request, str(error)[:LONGEST_ERROR])

    async def _refuse(self, request: dict[str, Any], why: str) -> None:
        operation, answer = request.get("op"), {"values": why, "result": False, **_id_of(request)}
        if operation == "call_service":
            await self._send({"op": "service_response", "service": request.get("service"), **answer})
        elif operation == "send_action_goal":
            await self._send({"op": "action_result", "action": request.get("action"), "status": _ABORTED, **answer})
        else:
            await self._tell("error", why, request)

    async def _tell(self, level: str, text: str, request: dict[str, Any]) -> None:
        if _LEVELS.index(level) <= self._level:
            await self._send({"op": "status", "level": level, "msg": text, **_id_of(request)})

    async def _set_level(self, request: dict[str, Any]) -> None:
        level = _text(request, "level")
        if level not in _LEVELS:
            raise _RefusedRequest(f"a level is one of {', '.join(_LEVELS)}, not {level!r}")
        self._level = _LEVELS.index(level)

    async def _subscribe(self, request: dict[str, Any]) -> None:
        topic, id_ = _topic(request), _id_of(request).get("id")
        if topic not in (*_TOPICS, _FEEDBACK, *self._named):
            known = ", ".join((*_TOPICS, _FEEDBACK, *self._named))
            raise _RefusedRequest(f"there is no topic {topic!r}; there are {known}")
        compression = _text(request, "compression", "none")
        if compression not in _COMPRESSIONS or (compression == "cbor-raw" and topic not in _TOPICS):
            await self._tell("warning", f"{compression!r} is not offered for {topic!r}: messages are in JSON", request)
            compression = "none"
        if request.get("fragment_size") is not None:
            await self._tell("warning", "fragments are not offered: messages come whole", request)
        period = min(_number(request, "throttle_rate", 0.0) / 1_000.0, _LONGEST_PERIOD)
        subscription = _Subscription(request["topic"], period, int(_number(request, "queue_length", 0.0)), compression)
        subscriptions = self._subscriptions.setdefault(topic, {})
        if id_ not in subscriptions and len(subscriptions) == MOST_REQUESTS:
            raise _RefusedRequest(f"{topic!r} has {MOST_REQUESTS} subscriptions already")
        subscriptions[id_] = subscription
        self._follow(topic)

    async def _unsubscribe(self, request: dict[str, Any]) -> None:
        topic = _topic(request)
        subscriptions = self._subscriptions.get(topic, {})
        if "id" in request:
            subscriptions.pop(_id_of(request).get("id"), None)
        else:
            subscriptions.clear()
        if subscriptions:
            self._follow(topic)
        else:
            self._subscriptions.pop(topic, None)
            self._stop(topic)

    def _follow(self, topic: str) -> None:
        """Begin to send a topic as all its subscriptions together want it, latched samples first."""
        if topic == _FEEDBACK:
            self._hears_feedback.set()
        elif topic in _TOPICS:
            self._start(topic, 0, lambda: self._send_topic(topic))
        else:
            self._begin(topic, self._named[topic], lambda transforms: self._send_transforms(topic, transforms))

    async def _advertise(self, request: dict[str, Any]) -> None:
        self._check_published(_topic(request))

    async def _unadvertise(self, request: dict[str, Any]) -> None:
        _topic(request)

    def _check_published(self, topic: str) -> None:
        if topic in _TOPICS and not self._server._may_publish:
            raise _RefusedRequest(f"this server takes nothing on {topic}: it was made without publish=True")
        if topic not in (*_TOPICS, _GOAL, _CANCEL):
            raise _RefusedRequest(f"nobody hears the topic {topic!r}; there are {', '.join(_TOPICS)}, {_GOAL}")

    async def _publish(self, request: dict[str, Any]) -> None:
        topic, message = _topic(request), request.get("msg")
        self._check_published(topic)
        if topic in _TOPICS:
            await self._publish_transforms(topic, message)
        elif topic == _CANCEL:
            id_ = _text(_fields(message, "msg"), "id", "")
            for goal in [_goal_of(id_)] if id_ else [key for key in self._scopes if key.startswith(_goal_of(""))]:
                self._stop(goal)
        else:
            fields = _fields(message, "msg")
            id_ = _text(_fields(fields.get("goal_id"), "goal_id"), "id")
            status = {"goal_id": {"stamp": _stamp(0), "id": id_}, "status": _ACTIVE, "text": ""}

            async def say(transforms: Sequence[TransformStamped]) -> None:
                header = {"stamp": _stamp(self._server.bus.clock.now()), "frame_id": ""}
                feedback = {"header": header, "status": status, "feedback": _message(transforms)}
                await self._hears_feedback.wait()
                await self._send_message(_FEEDBACK, feedback, transforms)

            self._begin(_goal_of(id_), _republication_of(fields.get("goal"), "goal"), say)

    async def _publish_transforms(self, topic: str, message: Any) -> None:
        rows = _fields(message, "msg").get("transforms")
        if not isinstance(rows, list):
            raise _RefusedRequest("transforms must be a list")
        errors: list[str] = []
        for first in range(0, len(rows), MOST_AT_ONCE):
            try:
                decoded = decode_mapping({"transforms": rows[first : first + MOST_AT_ONCE]})
            except MalformedMessageError as error:
                raise _RefusedRequest(str(error)) from None
            errors += map(str, decoded.errors)
            news: list[TransformStamped] = []
            known: list[TransformStamped] = []
            for sample in filter(None, decoded.samples):
                parent, child, stamp = sample.parent, sample.child, sample.stamp
                own = TransformStamped(parent, child, stamp, sample.transform, "rosbridge", _TOPICS[topic])
                if child not in self._published and len(self._published) == MOST_FRAMES:
                    errors.append(f"a page publishes at most {MOST_FRAMES} frames, without {child!r}")
                else:
                    self._published.add(child)
                    (known if self._is_known(own) else news).append(own)
            self._server.bus.publish(news, invalid="drop")
            if known:
                # A program may look whether they have arrived: in ROS, it hears what it publishes.
                await self._send_transforms(topic, known)
            await self._socket.give_way()
        if errors:
            raise _RefusedRequest(f"{len(errors)} of {len(rows)} transforms are refused; the first: {errors[0]}")

    def _is_known(self, sample: TransformStamped) -> bool:
        """Whether the bus has this very sample: it would go round for ever between two buses that are linked twice."""
        at = LATEST if sample.static else sample.stamp
        try:
            held = self._server._buffer.lookup_nowait(sample.parent, sample.child, at)
        except TransformLookupError:
            return False
        return held.static == sample.static and held.transform == sample.transform

    async def _call_service(self, request: dict[str, Any]) -> None:
        service = _text(request, "service")
        if _full(service) != _SERVICE:
            raise _RefusedRequest(f"there is no service {service!r}; there is {_SERVICE}")
        republication = _republication_of(request.get("args"), "args")
        topic = f"{_REPUBLISHER}/tf_repub_{next(self._names)}"
        if len(self._named) == MOST_REQUESTS:
            oldest = next(iter(self._named))
            del self._named[oldest]
            self._stop(oldest)
        self._named[topic] = republication
        values = {"topic_name": topic}
        response = {"op": "service_response", "service": service, "values": values, "result": True}
        await self._send({**response, **_id_of(request)})

    async def _send_goal(self, request: dict[str, Any]) -> None:
        action, id_ = _text(request, "action"), _text(request, "id")
        if _full(action) != _REPUBLISHER:
            raise _RefusedRequest(f"there is no action {action!r}; there is {_REPUBLISHER}")
        if request.get("feedback") is not True:
            raise _RefusedRequest("the transforms are the feedback of this action, which was not asked for")

        async def say(transforms: Sequence[TransformStamped]) -> None:
            await self._send({"op": "action_feedback", "id": id_, "action": action, "values": _message(transforms)})

        self._begin(_goal_of(id_), _republication_of(request.get("args"), "args"), say)

    async def _cancel_goal(self, request: dict[str, Any]) -> None:
        action, id_ = _text(request, "action"), _text(request, "id")
        if _goal_of(id_) not in self._scopes:
            raise _RefusedRequest(f"there is no goal {id_!r}")
        self._stop(_goal_of(id_))
        result = {"op": "action_result", "id": id_, "action": action, "values": {}, "status": _CANCELED, "result": True}
        await self._send(result)

    # Work

    def _start(self, key: str, frames: int, work: Callable[[], Awaitable[None]]) -> None:
        """Begin some work in a task, in place of that with the same key."""
        self._stop(key)
        if sum(size for _, size in self._scopes.values()) + frames > MOST_FRAMES:
            raise _RefusedRequest(f"a page has at most {MOST_FRAMES} frames republished")
        scope = anyio.CancelScope()
        self._scopes[key] = scope, frames

        async def run() -> None:
            with scope, suppress(BusClosedError):
                await work()

        self._tasks.start_soon(run)

    def _stop(self, key: str) -> None:
        scope, _ = self._scopes.pop(key, (None, 0))
        if scope is not None:
            scope.cancel()

    async def _send_topic(self, topic: str) -> None:
        subscriptions = self._subscriptions[topic].values()
        period, length = (
            min(subscription.period for subscription in subscriptions),
            min(subscription.length for subscription in subscriptions),
        )
        server, static = self._server, _TOPICS[topic]
        newest_only = period > 0.0 and not length
        capacity = MOST_CONFLATED if newest_only else min(length or MOST_WAITING, MOST_WAITING)
        with server.bus.stream(capacity, "conflate" if newest_only else "drop_oldest") as batches:
            server._streams.add(batches)
            try:
                async for batch in batches:
                    samples = [sample for sample in batch if sample.static is static]
                    if samples:
                        await self._say_all(samples, lambda part: self._send_transforms(topic, part))
                        await anyio.sleep(period)
            finally:
                server._streams.discard(batches)
                server._dropped += batches.dropped

    def _begin(self, key: str, republication: _Republication, say: Say) -> None:
        # One without frames takes a task, too.
        self._start(key, max(1, len(republication.sources)), lambda: self._republish(republication, say))

    async def _republish(self, republication: _Republication, say: Say) -> None:
        newest: dict[str, TransformStamped] = {}
        arrived, sent = anyio.Event(), anyio.Event()

        async def follow(watch: Watch) -> None:
            while True:
                # After a jump back of the clock, the watch starts over.
                with suppress(ClockResetError):
                    async for transform in watch:
                        newest[transform.child] = transform
                        arrived.set()
                        await sent.wait()
                    return

        target, sources, min_translation, min_rotation, period = republication
        watch_of = partial(
            self._server._buffer.watch, target, min_translation=min_translation, min_rotation=min_rotation
        )
        with ExitStack() as watches:
            async with anyio.create_task_group() as tasks:
                for source in sources:
                    tasks.start_soon(follow, watches.enter_context(watch_of(source)))
                while True:
                    await arrived.wait()
                    for _ in range(_TURNS):
                        await anyio.lowlevel.checkpoint()
                    arrived, transforms = anyio.Event(), list(newest.values())
                    newest.clear()
                    await self._say_all(transforms, say)
                    await anyio.sleep(period)
                    sent.set()
                    sent = anyio.Event()


# Fields of requests


def _request_of(text: str | bytes) -> dict[str, Any]:
    if isinstance(text, bytes):
        raise _RefusedRequest("requests are in JSON here, not in bytes")
    try:
        request = json.loads(text)
    # For deep or huge requests, the parser raises errors of several kinds.
    except Exception as error:  # noqa: BLE001
        raise _RefusedRequest(f"a request is no JSON: {error}") from None
    return _fields(request, "request")


def _fields(value: Any, name: str) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise _RefusedRequest(f"{name} must be an object, not {_shown(value)}")
    return value


def _text(fields: dict[str, Any], name: str, default: str | None = None) -> str:
    value = fields.get(name, default)
    if not isinstance(value, str):
        raise _RefusedRequest(f"{name} must be a text, not {_shown(value)}")
    return value


def _number(fields: dict[str, Any], name: str, default: float) -> float:
    value = fields.get(name, default)
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value <= _LARGEST_NUMBER:
        raise _RefusedRequest(f"{name} must be a number from 0 to {_LARGEST_NUMBER:g}, not {_shown(value)}")
    return float(value)


def _shown(value: Any) -> str:
    return f"{type(value).__name__}" if isinstance(value, dict | list) else f"{value!r}"[:100]


def _id_of(request: dict[str, Any]) -> dict[str, str | int]:
    id_ = request.get("id")
    return {"id": id_} if isinstance(id_, str | int) else {}


def _full(name: str) -> str:
    return f"/{name.lstrip('/')}"


def _topic(request: dict[str, Any]) -> str:
    return _full(_text(request, "topic"))


def _goal_of(id_: str) -> str:
    """The key of a goal among the work; topics begin with a slash."""
    return f"goal {id_}"


def _republication_of(arguments: Any, name: str) -> _Republication:
    fields = _fields(arguments, name)
    sources = fields.get("source_frames")
    if not isinstance(sources, list):
        raise _RefusedRequest(f"source_frames must be a list, not {_shown(sources)}")
    names = [_frame(fields.get("target_frame")), *map(_frame, sources)]
    translation, rotation = _number(fields, "trans_thres", 0.0), _number(fields, "angular_thres", 0.0)
    if not (translation and rotation):
        # As tf2_web_republisher does.
        translation = rotation = 0.0
    rate = min(_number(fields, "rate", 10.0), HIGHEST_RATE)
    period = 1.0 / max(rate, 1.0 / _LONGEST_PERIOD)
    return _Republication(names[0], tuple(dict.fromkeys(names[1:])), translation, min(rotation, pi), period)


def _frame(name: Any) -> str:
    bare = name.lstrip("/") if isinstance(name, str) else ""
    if not bare:
        raise _RefusedRequest(f"the name of a frame must be a text that is not empty, not {_shown(name)}")
    return bare


# Messages


def _message(transforms: Sequence[TransformStamped]) -> dict[str, Any]:
    rows = [as_mapping(transform) for transform in transforms]
    for row, transform in zip(rows, transforms, strict=True):
        row["header"]["stamp"] = _stamp(transform.stamp)
    return {"transforms": rows}


def _stamp(stamp: int) -> dict[str, int]:
    seconds, nanoseconds = divmod(stamp, SECOND)
    return {"secs": seconds, "nsecs": nanoseconds, "sec": seconds, "nanosec": nanoseconds}
