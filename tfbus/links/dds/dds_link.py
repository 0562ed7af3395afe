"""`DdsLink`: the transforms of a ROS 2 system on a bus, and those of the bus there, over DDS.

Cyclone DDS has one domain of a number in a process, with one configuration. So links to the same domain share it, and
the last of them that ends deletes it: `domain`. Each link has a participant there, with a writer for each kind of frame
that it sends, and a reader for each topic that it hears.

A thread, `ReaderThread`, takes what the readers receive. It holds a message until the name of its node is known,
`Publishers`, and hands it to the link, which decodes it in the event loop. The event loop only writes, and a writer
never waits for a reader that is frozen. Joining and leaving may block, so worker threads do that.

A participant is a peer as long as one of its writers is matched, on any topic of transforms.
"""

import os
import re
import struct
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from threading import Lock, Thread
from typing import Any, Literal, Unpack, get_args
from xml.sax.saxutils import quoteattr

import anyio
import anyio.to_thread
from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsParticipant
from cyclonedds.core import DDSException
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.internal import InvalidSample
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

from tfbus._aio.loops import wait_for_all
from tfbus.bus.bus import Bus
from tfbus.geometry.stamped import TransformStamped
from tfbus.links.dds.readers import (
    PATIENCE,
    RETRY,
    Greeting,
    Publishers,
    ReaderThread,
    Take,
    delete,
    is_of_ros,
    join,
    name_of,
    program,
    publication,
    read,
)
from tfbus.links.dds.types import (
    Gid,
    NodeEntitiesInfo,
    ParticipantEntitiesInfo,
    RawClock,
    RawEntitiesInfo,
    RawJointState,
    RawOdometry,
    RawString,
    RawTFMessage,
)
from tfbus.links.ros.ros_link import MAX_SIZE, RosCarrier, RosLink, RosMessage
from tfbus.links.ros.settings import Other, RosOptions, RosSettings, as_domain, settings_of
from tfbus.links.seams import Joined, Left, Received
from tfbus.tf_message import MalformedMessageError, encode

Discovery = Literal["localhost", "subnet"]

_FAST_DDS = "1.15"
_PARTICIPANTS = 32
"""So many on one machine are found; as many as ROS 2 looks for by default."""

# Fast DDS 3 sends type information that Cyclone DDS takes for malformed, and then refuses to talk.
_COMPATIBILITY = f"<Compatibility><IgnoreTypeInformation>{_FAST_DDS}</IgnoreTypeInformation></Compatibility>"
_LOOPBACK = (
    '<General><Interfaces><NetworkInterface name="lo" multicast="false"/></Interfaces>'
    "<AllowMulticast>false</AllowMulticast></General>"
)


def configuration(discovery: Discovery | None = None, peers: Iterable[str] = (), own: str | None = None) -> str:
    """The configuration of Cyclone DDS, as its documentation describes it.

    Parameters
    ----------
    discovery : {"localhost", "subnet"}, optional
        Where others are looked for, by default as ``ROS_AUTOMATIC_DISCOVERY_RANGE`` says, or else this machine.
    peers : iterable of str
        Further machines to look at.
    own : str, optional
        A configuration in place of the two, XML or the URL of a file, by default the variable ``CYCLONEDDS_URI``.

    Raises
    ------
    ValueError
        If the discovery is neither of the two.
    """
    if discovery is None:
        subnet = os.environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "").upper() == "SUBNET"
        discovery = "subnet" if subnet else "localhost"
    if discovery not in get_args(Discovery):
        raise ValueError(f"discovery must be 'localhost' or 'subnet', not {discovery!r}")
    own = own or os.environ.get("CYCLONEDDS_URI") or None
    if own is not None:
        return f'{own},<CycloneDDS><Domain id="any">{_COMPATIBILITY}</Domain></CycloneDDS>'
    machines = (*(("127.0.0.1",) if discovery == "localhost" else ()), *peers)
    addresses = "".join(f"<Peer address={quoteattr(machine)}/>" for machine in machines)
    found = (
        "<Discovery><ParticipantIndex>auto</ParticipantIndex>"
        f"<MaxAutoParticipantIndex>{_PARTICIPANTS}</MaxAutoParticipantIndex>"
        f"{f'<Peers>{addresses}</Peers>' if addresses else ''}</Discovery>"
    )
    network = _LOOPBACK if discovery == "localhost" else ""
    return f'<CycloneDDS><Domain id="any">{network}{found}{_COMPATIBILITY}</Domain></CycloneDDS>'


class _SharedDomain:
    def __init__(self, number: int, config: str) -> None:
        self.config = config
        self.process = os.getpid()
        self.users = 0
        self.domain = Domain(number, config)


_lock = Lock()
_open: dict[int, _SharedDomain] = {}


@contextmanager
def domain(number: int, config: str) -> Iterator[None]:
    """Have a domain open with a configuration.

    Raises
    ------
    OSError
        If it cannot be opened, or is open in this process with another configuration.
    RuntimeError
        If this process was forked from one in which it was open.
    """
    with _lock:
        shared = _open.get(number)
        if shared is None:
            try:
                shared = _open[number] = _SharedDomain(number, config)
            except DDSException as error:
                raise OSError(f"cannot open the DDS domain {number}: {error}") from None
        elif shared.process != os.getpid():
            raise RuntimeError(
                f"this process was forked from one that has the DDS domain {number} open, whose threads are not here: "
                "start it with the method 'spawn' of multiprocessing"
            )
        elif shared.config != config:
            raise OSError(f"the DDS domain {number} is open in this process with another configuration")
        shared.users += 1
    try:
        yield
    finally:
        with _lock:
            shared.users -= 1
            if not shared.users:
                del _open[number]
                shared.domain.__del__()


_CLOSING_TIME = 1.0
_DEPTH = 5_000
"""So many messages wait in DDS for their reader. The topics have no keys, so all writers of a topic share them."""
_KEPT = 100
"""So many of its own messages a writer repeats when they were lost, as tf2's broadcasters do."""
_NODES = "ros_discovery_info"
_OTHERS = "other topics"
"""The sender of joint positions, the time, a description and odometry."""
_UNKNOWN = "", ""
"""The ids of a writer and its participant that the library does not tell."""
_TYPES: dict[Other, Any] = {
    "joints": RawJointState,
    "clock": RawClock,
    "description": RawString,
    "odometry": RawOdometry,
}
_AT_ONCE = 16
_BYTES_AT_ONCE = 2**20
_BATCHES = 10
"""So many of these, within so many bytes, are taken of a reader before others have their turn."""
# A writer never waits for a reader that is frozen: the event loop would.
_RELIABLE = (
    Policy.Reliability.Reliable(duration(seconds=0)),
    Policy.IgnoreLocal.Participant,
    Policy.DataRepresentation(use_cdrv0_representation=True),
)
_MOVING = Qos(*_RELIABLE, Policy.Durability.Volatile, Policy.History.KeepLast(_KEPT))
_HEARD = Qos(*_RELIABLE, Policy.Durability.Volatile, Policy.History.KeepLast(_DEPTH))
# A second reader only listens, and nobody takes what comes.
_SECOND = Qos(*_RELIABLE, Policy.Durability.Volatile, Policy.History.KeepLast(1))
_STATIC = Qos(*_RELIABLE, Policy.Durability.TransientLocal, Policy.History.KeepLast(1))
# Each publisher has its own last message.
_STATICS = Qos(*_RELIABLE, Policy.Durability.TransientLocal, Policy.History.KeepLast(_DEPTH))
# Drivers of joints and simulations may be best effort.
_ANY = Qos(Policy.Reliability.BestEffort, Policy.IgnoreLocal.Participant, Policy.History.KeepLast(_DEPTH))


class ReadingError(MalformedMessageError):
    """An error that has kept messages from being read; it is counted like a malformed message, though none was."""

    def __str__(self) -> str:
        return self.detail


class DdsCarrier(RosCarrier):
    """Reads and writes the topics of a DDS domain; see `RosCarrier`.

    Parameters
    ----------
    number : int
        The domain.
    config : str
        Of Cyclone DDS.
    settings : RosSettings
    """

    def __init__(self, number: int, config: str, settings: RosSettings) -> None:
        super().__init__(f"dds:{number}", settings)
        self._number = number
        self._config = config
        self._open = ExitStack()
        self._publishers = Publishers(self)
        self._participants: BuiltinDataReader | None = None
        # The ids of the writers that each reader is matched with and of their participants, by the library's numbers.
        self._writers: defaultdict[DataReader[Any], dict[int, tuple[str, str]]] = defaultdict(dict)
        self._greetings: dict[int, Greeting] = {}
        self._behind: dict[DataReader[Any], int] = {}
        self._present: set[str] = set()
        self._subscriptions: list[DataReader[Any]] = []
        self._moving_writer: DataWriter[RawTFMessage]
        self._static_writer: DataWriter[RawTFMessage]

    async def _connect(self) -> None:
        await anyio.to_thread.run_sync(self._join)

    def _join(self) -> None:
        try:
            self._open.enter_context(domain(self._number, self._config))
            participant = join(self._number, self._open)
            topics = {
                name: Topic(participant, f"rt{name}", RawTFMessage)
                for name in (*self.settings.tf, *self.settings.tf_static)
            }
            if self.settings.send:
                self._moving_writer = DataWriter(participant, topics[self.settings.tf[0]], _MOVING)
                self._static_writer = DataWriter(participant, topics[self.settings.tf_static[0]], _STATIC)
                for writer in (self._moving_writer, self._static_writer):
                    self._open.callback(delete, writer)
            thread = ReaderThread(participant, self._failed)
            if self.settings.authority is None:
                self._participants = BuiltinDataReader(participant, BuiltinTopicDcpsParticipant)
                self._open.callback(delete, self._participants)
                info = Topic(participant, _NODES, RawEntitiesInfo)
                thread.watch(self._reader(participant, info, _STATICS), self._take_nodes)
            for other, names in self.settings.others.items():
                for name in names:
                    topic = Topic(participant, f"rt{name}", _TYPES[other])
                    # A description is latched, as static frames are.
                    reader = self._reader(participant, topic, _STATICS if other == "description" else _ANY)
                    thread.watch(reader, partial(self._take_other, other, name))
            for number, name in enumerate((*self.settings.tf_static, *self.settings.tf)):
                static = number < len(self.settings.tf_static)
                reader = self._reader(participant, topics[name], _STATICS if static else _HEARD)
                if not static:
                    self._greetings[number] = Greeting(partial(DataReader, participant, topics[name], _SECOND))
                    self._open.callback(self._greetings[number].close)
                take = partial(self._take, static)
                thread.watch(reader, take, partial(self._match, number, take))
            self._introduce(participant)
            thread.start()
            self._open.callback(thread.stop)
        except DDSException as error:
            raise OSError(f"cannot join the DDS domain {self._number}: {error}") from None

    def _reader(self, participant: DomainParticipant, topic: Topic[Any], qos: Qos) -> DataReader[Any]:
        reader: DataReader[Any] = DataReader(participant, topic, qos)
        self._open.callback(delete, reader)
        self._subscriptions.append(reader)
        return reader

    def _introduce(self, participant: DomainParticipant) -> None:
        """Tell ROS 2 that this program is a node, and that it has gone when the link ends.

        Without the second, Fast DDS lists the node until it has not heard of the participant for 10 s.
        """
        telling: DataWriter[ParticipantEntitiesInfo]
        telling = DataWriter(participant, Topic(participant, _NODES, ParticipantEntitiesInfo), _STATIC)
        self._open.callback(delete, telling)

        def tell(*nodes: NodeEntitiesInfo) -> None:
            sequence: Any = nodes
            with suppress(DDSException):
                telling.write(ParticipantEntitiesInfo(Gid.of(participant), sequence))

        name: Any = re.sub(r"[\W_]+", "_", program(), flags=re.ASCII).strip("_")
        publishers = (self._moving_writer, self._static_writer) if self.settings.send else ()
        ids: list[Any] = [[Gid.of(each) for each in entities] for entities in (self._subscriptions, publishers)]
        root: Any = "/"
        tell(NodeEntitiesInfo(root, name, *ids))
        self._open.callback(tell)

    async def run(self) -> None:
        """Let no message wait for the name of its node for ever."""
        while True:
            await anyio.sleep(PATIENCE / 2)
            self._publishers.expire()

    async def close(self) -> None:
        """Leave the domain, or give up waiting for that."""
        closing = Thread(target=self._open.close, name="tfbus dds close", daemon=True)
        closing.start()
        await wait_for_all([closing], _CLOSING_TIME)

    def _publish(self, samples: Sequence[TransformStamped], static: bool) -> bool:
        try:
            (self._static_writer if static else self._moving_writer).write(RawTFMessage.of(encode(samples)))
        except DDSException as error:
            self._report.failed(error)
            return False
        return True

    # The thread of the readers calls the methods below.

    def _take(self, static: bool, reader: DataReader[RawTFMessage]) -> bool:
        return self._take_each(reader, partial(self._take_transforms, static, reader))

    def _take_transforms(self, static: bool, reader: DataReader[RawTFMessage], message: Any) -> None:
        handle = message.sample_info.publication_handle
        publisher, participant = self._writers[reader].get(handle) or self._find(reader, handle)
        if self.settings.authority is None:
            self._publishers.message(publisher, participant, message.payload, static)
        else:
            self.deliver(participant, "", message.payload, static)

    def _take_each(self, reader: DataReader[Any], take: Callable[[Any], object]) -> bool:
        """Call a function with each of some messages that wait; returns whether more may wait."""
        count = size = 0
        while count < _BATCHES * _AT_ONCE and size < _BYTES_AT_ONCE:
            messages: list[Any] = reader.take(N=_AT_ONCE)
            count += len(messages)
            for message in messages:
                # One without data tells of a writer that has gone.
                if not isinstance(message, InvalidSample):
                    size += len(message.payload)
                    try:
                        take(message)
                    except Exception as error:  # noqa: BLE001 - the others are taken all the same
                        self._failed(error)
            if len(messages) < _AT_ONCE:
                self._count_waiting(reader, count)
                self._behind.pop(reader, None)
                return False
        self._count_waiting(reader, count)
        return True

    def _count_waiting(self, reader: DataReader[Any], count: int) -> None:
        """Tell when as many messages have waited in a row as DDS keeps, for it does not tell what it overwrites."""
        behind = self._behind.get(reader, 0) + count
        if behind >= _DEPTH:
            behind = 0
            topic = reader.topic.name.removeprefix("rt")
            detail = f"messages of {topic} come faster than they are taken, some may be lost"
            self._receive(Received("", ReadingError("overrun", detail)))
        self._behind[reader] = behind

    def _find(self, reader: DataReader[RawTFMessage], handle: int) -> tuple[str, str]:
        """The ids of a writer and its participant; empty if it has gone since, or the library cannot read its data."""
        try:
            found = publication(reader, handle)
        except UnicodeDecodeError as error:
            # A stranger has given the writer such a name.
            self._failed(error)
            found = None
        return _UNKNOWN if found is None else (found.key.hex, found.participant_key.hex)

    def is_of_ros(self, participant: str) -> bool:
        """Whether a participant has the user data that ROS 2 gives it."""
        if self._participants is None:
            return False
        return any(is_of_ros(each) for each in read(self._participants) if each.key.hex == participant)

    def name_of(self, participant: str) -> str:
        """The name of a participant, by its id; the id if it has none."""
        known = () if self._participants is None else read(self._participants)
        return next((name_of(each) for each in known if each.key.hex == participant), "") or participant

    def _take_nodes(self, reader: DataReader[RawEntitiesInfo]) -> bool:
        return self._take_each(reader, self._take_node)

    def _take_node(self, message: RawEntitiesInfo) -> None:
        if len(message.payload) > MAX_SIZE:
            detail = f"{len(message.payload)} bytes of names of nodes, more than {MAX_SIZE}"
            self._receive(Received("", MalformedMessageError("oversized", detail)))
            return
        try:
            participant, nodes = message.read()
        except (ValueError, struct.error) as error:
            detail = f"no names of nodes: {error!r}"[:200]
            self._receive(Received("", MalformedMessageError("encoding", detail)))
        else:
            self._publishers.nodes(participant, nodes)

    def _take_other(self, other: Other, topic: str, reader: DataReader[Any]) -> bool:
        return self._take_each(reader, partial(self._pass_other, other, topic))

    def _pass_other(self, other: Other, topic: str, message: Any) -> None:
        self._pass_on(_OTHERS, RosMessage(message.payload, False, topic, other))

    def _match(self, number: int, take: Take, reader: DataReader[RawTFMessage]) -> float | None:
        try:
            handles = reader.get_matched_publications()
        except IndexError:
            # Another writer has come between the two calls that the library makes for this.
            return RETRY
        # The library's numbers have a sign here, and none in messages.
        found = {handle % 2**64: self._find(reader, handle) for handle in handles}
        if self._writers[reader].items() - found.items():
            # All messages of writers that have gone, because the library knows these no more.
            for _ in range(_DEPTH // _AT_ONCE):
                if not take(reader):
                    break
        self._writers[reader] = {handle: ids for handle, ids in found.items() if ids != _UNKNOWN}
        present = {participant for known in self._writers.values() for _, participant in known.values()}
        self._publishers.keep_only(present)
        for participant in sorted(present - self._present):
            self._receive(Received(participant, Joined()))
        for participant in sorted(self._present - present):
            self._receive(Received(participant, Left()))
        self._present = present
        greeting = self._greetings.get(number)
        return None if greeting is None else greeting.update({writer for writer, _ in self._writers[reader].values()})

    def _failed(self, error: Exception) -> None:
        """Count and tell an error that has kept messages from being read."""
        self._receive(Received("", ReadingError("not read", f"DDS cannot be read: {error!r}"[:200])))

    def deliver(self, participant: str, authority: str, payload: bytes, static: bool) -> None:
        self._pass_on(participant, RosMessage(payload, static, authority))


class DdsLink(RosLink):
    """Joins a bus to ``/tf`` and ``/tf_static`` of ROS 2 over DDS: ``async with DdsLink(bus) as link``.

    No ROS is needed, here or while it is installed. It speaks with ROS 2 programs of any vendor of DDS, as they are.

    Parameters
    ----------
    bus : Bus
    domain : int, optional
        The number that ROS 2 programs have as ``ROS_DOMAIN_ID``, from 0 to 232; by default, this program's
        ``ROS_DOMAIN_ID``, or else 0.
    discovery : {"localhost", "subnet"}, optional
        Whether only programs on this machine are found, or those on the local network too; by default as
        ``ROS_AUTOMATIC_DISCOVERY_RANGE`` says, or else ``"localhost"``.
    peers : iterable of str
        Machines beyond that, by name or address.
    config : str, optional
        A configuration of Cyclone DDS in place of the two, XML or the URL of a file, by default the variable
        ``CYCLONEDDS_URI``.
    **options
        All links to ROS share them: see `tfbus.links.ros.RosLink`. By default, the authority of a sample is the
        node that has published it, such as ``/robot_state_publisher``; for a program that is no node, the name of its
        participant, or else the id of that.

    Attributes
    ----------
    bus : Bus
    domain : int
    id : str
        The name of this end.

    Raises
    ------
    ValueError
        If the domain or the discovery is out of range, or as `tfbus.links.ros.RosLink`.
    TypeError
        If an argument has the wrong type.
    OSError
        On entering, if the domain cannot be joined, or is open in this process with other settings.
    BusClosedError, RuntimeError
        On entering, if the bus is closed; if it belongs to another thread, the link was entered before, or the process
        was forked from one that has the domain open.
    ImportError
        On import, without the extra: ``pip install "tfbus[dds]"``.

    Notes
    -----
    The qualities of service are those of tf2: all is reliable, ``/tf_static`` is transient local. A peer is a process
    with a broadcaster. Entering takes up to 1.6 s where there are ROS 2 programs, and then their frames come at once.
    Every program that reaches the domain can publish there, and read everything. The link is a node, named after the
    program and its process, such as ``/tfbus_robot_py_4711``, for ``ros2 node list``; its participant is
    ``tfbus robot.py [4711]``, for tools of DDS such as ``cyclonedds ps``.

    Examples
    --------
    >>> async def show(bus: Bus, buffer: Buffer) -> None:
    ...     async with DdsLink(bus, domain=42):
    ...         print(await buffer.lookup("map", "base_link", timeout=5.0))
    """

    def __init__(
        self,
        bus: Bus,
        domain: int | None = None,
        *,
        discovery: Discovery | None = None,
        peers: Iterable[str] = (),
        config: str | None = None,
        **options: Unpack[RosOptions],
    ) -> None:
        if isinstance(peers, str):
            raise TypeError(f"peers must be several machines, not {peers!r}")
        self.domain: int = as_domain(domain)
        carrier = DdsCarrier(self.domain, configuration(discovery, peers, config), settings_of(options))
        super().__init__(bus, carrier.id, carrier, **options)
