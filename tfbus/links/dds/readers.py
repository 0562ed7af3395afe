"""A link hears a DDS domain: it joins so that nothing is lost, and a thread takes messages and names their nodes.

As soon as a participant of Fast DDS hears of another one, it tells of its writers, and as soon as it hears of a reader,
it sends what is latched. Cyclone DDS drops both while it does not know their sender, and Fast DDS repeats them only
with its next heartbeat, after 3 s. So in `join`, a participant without readers makes itself heard first. When it knows
the others, a second one joins, which all tell once more of themselves; it gets its readers when it knows the writers.
The writers of a program that comes later meet readers which are there already: `Greeting` is for these.

`ReaderThread` waits for all readers in one thread, without listeners. The library calls a listener while it keeps its
reader, and a listener in Python first waits for the interpreter lock; `DataWriter.write` keeps that lock while it
delivers to readers of the same process. So two links of one process to one domain, and a third program, would sooner or
later wait for each other for ever.

ROS 2 tells on a topic of its own which node has which writer. `Publishers` holds messages until it has done so.
"""

import os
import sys
from collections.abc import Callable, Iterable
from contextlib import ExitStack
from dataclasses import dataclass, field
from math import inf
from pathlib import Path
from threading import Lock, Thread
from time import monotonic, sleep
from typing import Any, Protocol

from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsParticipant, BuiltinTopicDcpsPublication
from cyclonedds.core import DDSStatus, Entity, GuardCondition, WaitSet
from cyclonedds.domain import DomainParticipant
from cyclonedds.internal import InvalidSample
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.util import duration

ANSWER_TIME = 0.06
"""s; a program that has not answered by then is met later."""
QUIET_TIME = 0.02
"""s; if nobody else answers for so long, all have."""
WRITERS_TIME = 1.5
"""s; the longest that the writers of those are waited for."""
GREETING_TIME = 0.5
"""s; for so long there is a second reader, which new writers greet."""
_READING = Lock()
"""The library reads the settings of others by memory that all threads share, and two threads would free it twice."""
_PERIOD = 0.002
_MOST = 10_000
_LONGEST_NAME = 256
_LONGEST_PROGRAM = 200
_OF_ROS = b"enclave="
_CYCLONE = "0110"
"""The ids of writers of Cyclone DDS begin so; it greets until it is understood."""


def join(number: int, stack: ExitStack) -> DomainParticipant:
    """A participant that knows the writers of the ROS 2 programs that are in a domain; it leaves with the stack.

    Raises
    ------
    DDSException
        If the domain cannot be joined.
    """
    # The library talks of endpoints through the first participant of a process, so this one stays.
    named = Qos(Policy.EntityName(program()))
    first = DomainParticipant(number, named)
    stack.callback(delete, first)
    programs = _answering(first)
    participant = DomainParticipant(number, named)
    stack.callback(delete, participant)
    writers = BuiltinDataReader(participant, BuiltinTopicDcpsPublication)
    _wait(lambda: programs <= {each.participant_key.hex for each in read(writers)}, WRITERS_TIME)
    delete(writers)
    return participant


def program() -> str:
    """The name of this program and the number of its process, which tools of DDS show."""
    # DDS takes UTF-8 only, and a file may have any name.
    name = Path(sys.argv[0]).name.encode(errors="replace").decode()
    return f"tfbus {name[:_LONGEST_PROGRAM] or 'python'} [{os.getpid()}]"


def read(reader: BuiltinDataReader) -> list[Any]:
    """All that the library tells of, such as participants; nothing while a name among them is no text."""
    try:
        with _READING:
            found: list[Any] = reader.read(N=_MOST)
    except UnicodeDecodeError:
        # A stranger has called a participant so. The library reads all of them or none.
        return []
    return [each for each in found if not isinstance(each, InvalidSample)]


def publication(reader: DataReader[Any], handle: int) -> Any:
    """All that the library tells of a writer that a reader is matched with; None if it has gone since.

    Raises
    ------
    UnicodeDecodeError
        If a name of it is no text.
    """
    with _READING:
        return reader.get_matched_publication_data(handle)


def name_of(participant: Any) -> str:
    """The name of a participant, as the library tells of it; empty if it has none."""
    name: str = participant.qos[Policy.EntityName].name if Policy.EntityName in participant.qos else ""
    return name[:_LONGEST_NAME]


def is_of_ros(participant: Any) -> bool:
    """Whether a participant, as the library tells of it, has the user data that ROS 2 gives it."""
    data: bytes = participant.qos[Policy.Userdata].data if Policy.Userdata in participant.qos else b""
    return data.startswith(_OF_ROS)


class Greeting:
    """Has the first message of a new writer come whole, however large it is.

    A writer greets a new reader: its heartbeat tells where its messages begin. Fast DDS does so once, as soon as it has
    heard of the reader, and Cyclone DDS often does not know the writer by then. Then the next heartbeat counts as the
    greeting, and earlier messages are dropped unless they are whole; Fast DDS sends that heartbeat between the parts of
    the first large message. A second reader has the writer greet once more, and that counts for all readers of the
    participant.

    Parameters
    ----------
    make : callable
        Makes a second reader of the same topic and quality.
    now : callable
        Returns a monotonic time in s.
    """

    def __init__(self, make: Callable[[], DataReader[Any]], now: Callable[[], float] = monotonic) -> None:
        self._make = make
        self._now = now
        self._met: set[str] = set()
        self._wanted = False
        self._second: DataReader[Any] | None = None
        self._until = 0.0

    def update(self, writers: set[str]) -> float | None:
        """Take the ids of all writers that there are; returns after how many seconds to call this again, if at all."""
        self._wanted |= any(not writer.startswith(_CYCLONE) for writer in writers - self._met)
        self._met = writers
        if self._second is not None and self._now() >= self._until:
            self.close()
        if self._second is None and self._wanted:
            self._second = self._make()
            self._wanted = False
            self._until = self._now() + GREETING_TIME
        return None if self._second is None else max(0.0, self._until - self._now())

    def close(self) -> None:
        """Delete the second reader, if there is one."""
        if self._second is not None:
            delete(self._second)
            self._second = None


def delete(entity: Entity) -> None:
    """Delete an entity now; by itself, the library does it when nothing refers to it any more, in any order."""
    entity.__del__()


def _answering(participant: DomainParticipant) -> set[str]:
    """The ids of the ROS 2 programs that answer when a participant has joined."""
    reader = BuiltinDataReader(participant, BuiltinTopicDcpsParticipant)
    heard = {participant.guid.hex: participant}
    until = monotonic() + ANSWER_TIME

    def are_all_there() -> bool:
        nonlocal until
        now = {each.key.hex: each for each in read(reader)}
        if now.keys() - heard.keys():
            heard.update(now)
            until = monotonic() + QUIET_TIME
        return monotonic() >= until

    _wait(are_all_there, WRITERS_TIME)
    delete(reader)
    del heard[participant.guid.hex]
    return {id_ for id_, each in heard.items() if is_of_ros(each)}


def _wait(is_true: Callable[[], bool], limit: float) -> None:
    """Wait in this thread, which is a worker's, until a condition holds or the time is over."""
    end = monotonic() + limit
    while not is_true() and monotonic() < end:
        sleep(_PERIOD)


_FOR_EVER = duration(infinite=True)
RETRY = 0.05
"""s; after so long, a function that has raised is called again."""

Take = Callable[[DataReader[Any]], bool]
Match = Callable[[DataReader[Any]], float | None]


@dataclass(slots=True)
class _Watched:
    reader: DataReader[Any]
    take: Take
    match: Match | None
    has_data: bool = False
    match_at: float = inf


class ReaderThread:
    """Waits for the readers of a participant, and calls functions, in a thread of its own.

    Nothing that a function raises ends the thread, or keeps another function from being called.

    Parameters
    ----------
    participant : DomainParticipant
    failed : callable
        Called with what one of the functions has raised.
    """

    def __init__(self, participant: DomainParticipant, failed: Callable[[Exception], object]) -> None:
        self._failed = failed
        self._watched: list[_Watched] = []
        self._stopped = GuardCondition(participant)
        self._waiting = WaitSet(participant)
        self._waiting.attach(self._stopped)
        self._thread = Thread(target=self._run, name="tfbus dds", daemon=True)

    def watch(self, reader: DataReader[Any], take: Take, match: Match | None = None) -> None:
        """Call `take` when a reader has data, and `match` when its writers have changed; before `start`.

        `take` takes some messages, and returns whether more of them wait: other readers have their turn first. `match`
        may return after how many seconds it is to be called again; one that has raised is called again in any case.
        """
        matched = 0 if match is None else DDSStatus.SubscriptionMatched
        reader.set_status_mask(DDSStatus.DataAvailable | matched)
        self._waiting.attach(reader)
        self._watched.append(_Watched(reader, take, match))

    def start(self) -> None:
        """Begin, with what the readers have already."""
        self._thread.start()

    def stop(self) -> None:
        """End, and let go of the readers."""
        self._stopped.set(True)
        self._thread.join()
        self._watched.clear()
        delete(self._waiting)
        # When it is collected, it would detach whatever has their numbers by then.
        self._waiting.attached.clear()
        delete(self._stopped)

    def _run(self) -> None:
        while True:
            try:
                self._waiting.wait(self._timeout())
                if self._stopped.read():
                    return
            except Exception as error:  # noqa: BLE001 - the library may fail once
                self._failed(error)
                sleep(RETRY)
            for watched in self._watched:
                self._serve(watched)

    def _timeout(self) -> int:
        if any(watched.has_data for watched in self._watched):
            return 0
        due = min((watched.match_at for watched in self._watched), default=inf)
        return _FOR_EVER if due == inf else duration(seconds=max(0.0, due - monotonic()))

    def _serve(self, watched: _Watched) -> None:
        try:
            # Before the data are taken: what comes later is told again.
            told = watched.reader.take_status()
        except Exception as error:  # noqa: BLE001 - then it is told the next time
            self._failed(error)
            told = 0
        watched.has_data |= bool(told & DDSStatus.DataAvailable)
        if watched.match is not None and (told & DDSStatus.SubscriptionMatched or monotonic() >= watched.match_at):
            watched.match_at = monotonic() + RETRY
            try:
                again = watched.match(watched.reader)
                watched.match_at = inf if again is None else monotonic() + again
            except Exception as error:  # noqa: BLE001 - it is called again, and what has come is taken all the same
                self._failed(error)
        if watched.has_data:
            watched.has_data = False
            try:
                watched.has_data = watched.take(watched.reader)
            except Exception as error:  # noqa: BLE001 - nothing that others send may end the thread
                self._failed(error)


PATIENCE = 0.5
"""s; a message waits so long for the name of its node, which ROS 2 tells on another topic."""
NODE_PATIENCE = 5.0
"""s; and so long if its participant is known to be of ROS 2: what was lost while two meet is sent again after 3."""
MOST_WAITING = 1_000
MOST_BYTES = 2**24
"""Bytes of all messages that wait; beyond that, none of their publisher does."""
MOST_PUBLISHERS = 10_000


class Hearer(Protocol):
    """Takes messages with their names, and knows the participants."""

    def deliver(self, participant: str, authority: str, payload: bytes, static: bool) -> object:
        """Take a message, with the name of its node, or else that of its participant."""

    def name_of(self, participant: str) -> str:
        """The name of a participant, by its id; the id if it has none."""

    def is_of_ros(self, participant: str) -> bool:
        """Whether a participant, by its id, is known to be of ROS 2, and so will tell the names of its nodes."""


@dataclass(slots=True)
class _Publisher:
    """One publisher; `name` is empty until it is known."""

    participant: str
    until: float
    name: str = ""
    waiting: list[tuple[bytes, bool]] = field(default_factory=list)


class Publishers:
    """Holds each message until the name of its node is known, or it has waited long enough; for any thread.

    Without that, the first messages of a publisher would come from another authority than the later ones.

    Parameters
    ----------
    hearer : Hearer
        Takes the messages.
    now : callable
        Returns a monotonic time in s.
    """

    def __init__(self, hearer: Hearer, now: Callable[[], float] = monotonic) -> None:
        self._hearer = hearer
        self._now = now
        self._lock = Lock()
        self._publishers: dict[str, _Publisher] = {}
        self._names: dict[str, dict[str, str]] = {}
        self._named = 0
        self._bytes = 0

    def __len__(self) -> int:
        """The number of publishers and names of publishers that are remembered."""
        with self._lock:
            return len(self._publishers) + self._named

    def message(self, publisher: str, participant: str, payload: bytes, static: bool) -> None:
        """Take a message of a publisher."""
        with self._lock:
            known = self._publishers.get(publisher)
            if known is None:
                if len(self._publishers) >= MOST_PUBLISHERS:
                    self._flush(self._publishers.pop(next(iter(self._publishers))))
                patience = NODE_PATIENCE if self._hearer.is_of_ros(participant) else PATIENCE
                known = self._publishers[publisher] = _Publisher(participant, self._now() + patience)
                known.name = self._names.get(participant, {}).get(publisher, "")
            known.waiting.append((payload, static))
            self._bytes += len(payload)
            if known.name or len(known.waiting) > MOST_WAITING or self._bytes > MOST_BYTES:
                self._flush(known)

    def nodes(self, participant: str, names: Iterable[tuple[str, Iterable[str]]]) -> None:
        """Take the names of all nodes of a participant, each with its publishers."""
        with self._lock:
            known = {publisher: name for name, publishers in names for publisher in publishers}
            self._named += len(known) - len(self._names.pop(participant, ()))
            if known:
                self._names[participant] = known
            while self._named > MOST_PUBLISHERS:
                self._named -= len(self._names.pop(next(iter(self._names))))
            for id_, name in known.items():
                publisher = self._publishers.get(id_)
                if publisher is not None and publisher.waiting:
                    publisher.name = name
                    self._flush(publisher)

    def expire(self) -> None:
        """Deliver what has waited long enough."""
        with self._lock:
            for publisher in self._publishers.values():
                if publisher.waiting and self._now() >= publisher.until:
                    self._flush(publisher)

    def keep_only(self, participants: set[str]) -> None:
        """Forget the publishers of all other participants, which have gone."""
        with self._lock:
            for publisher in [id_ for id_, each in self._publishers.items() if each.participant not in participants]:
                self._flush(self._publishers.pop(publisher))

    def _flush(self, publisher: _Publisher) -> None:
        publisher.name = publisher.name or self._hearer.name_of(publisher.participant)
        waiting, publisher.waiting = publisher.waiting, []
        self._bytes -= sum(len(payload) for payload, _ in waiting)
        for payload, static in waiting:
            self._hearer.deliver(publisher.participant, publisher.name, payload, static)
