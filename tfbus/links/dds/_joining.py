"""`join`, which spares a link the seconds after which ROS 2 repeats what was lost.

As soon as a participant of Fast DDS hears of another one, it tells of its writers, and as soon as it hears of a reader,
it sends what is latched. Cyclone DDS drops both while it does not know their sender, and Fast DDS repeats them only
with its next heartbeat, after 3 s. So a participant without readers makes itself heard first. When those who answer are
known, a second one joins, to which all is told once more; and it gets its readers when it knows the writers.

The writers of a program that comes later meet readers which are there already: `Greeting` is for these.
"""

from collections.abc import Callable
from contextlib import ExitStack
from time import monotonic, sleep
from typing import Any

from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsParticipant, BuiltinTopicDcpsPublication
from cyclonedds.core import Entity
from cyclonedds.domain import DomainParticipant
from cyclonedds.internal import InvalidSample
from cyclonedds.qos import Policy
from cyclonedds.sub import DataReader

ANSWER_TIME = 0.06
"""s; whoever has not answered by then is met later."""
QUIET_TIME = 0.02
"""s; if nobody else answers for so long, all have."""
WRITERS_TIME = 1.5
"""s; the longest that the writers of those are waited for."""
GREETING_TIME = 0.5
"""s; for so long there is a second reader, which new writers greet."""
_PERIOD = 0.002
_MOST = 10_000
_OF_ROS = b"enclave="
_CYCLONE = "0110"
"""The ids of whatever Cyclone DDS has made begin so; it greets until it is understood."""


def join(number: int, stack: ExitStack) -> DomainParticipant:
    """A participant that knows the writers of the ROS 2 programs that are in a domain; it leaves with the stack.

    Raises
    ------
    DDSException
        If the domain cannot be joined.
    """
    # The library talks of endpoints through the first participant of a process, so this one stays.
    first = DomainParticipant(number)
    stack.callback(delete, first)
    programs = _answering(first)
    participant = DomainParticipant(number)
    stack.callback(delete, participant)
    writers = BuiltinDataReader(participant, BuiltinTopicDcpsPublication)
    _wait(lambda: programs <= {each.participant_key.hex for each in read(writers)}, WRITERS_TIME)
    delete(writers)
    return participant


def read(reader: BuiltinDataReader) -> list[Any]:
    """All that the library tells of, such as participants; nothing while a name among them is no text."""
    try:
        found: list[Any] = reader.read(N=_MOST)
    except UnicodeDecodeError:
        # A stranger has called a participant so. The library reads all of them or none.
        return []
    return [each for each in found if not isinstance(each, InvalidSample)]


def is_of_ros(participant: Any) -> bool:
    """Whether a participant, as the library tells of it, has the user data that ROS 2 gives it."""
    data: bytes = participant.qos[Policy.Userdata].data if Policy.Userdata in participant.qos else b""
    return data.startswith(_OF_ROS)


class Greeting:
    """Has the first message of a new writer come whole, however large it is.

    A writer greets a new reader: its heartbeat tells where its messages begin. Fast DDS does so once, as soon as it has
    heard of the reader, and Cyclone DDS often does not know the writer by then. Then the next heartbeat counts as the
    greeting, and what came before it is dropped unless it is whole; Fast DDS sends that heartbeat between the parts of
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
        self._met: frozenset[str] = frozenset()
        self._wanted = False
        self._second: DataReader[Any] | None = None
        self._until = 0.0

    def update(self, writers: frozenset[str]) -> float | None:
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
