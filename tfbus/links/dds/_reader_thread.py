"""`ReaderThread`, which hands on what the readers of a DDS participant receive.

There are no listeners. The library calls one while it keeps its reader, and a listener in Python first waits for the
interpreter lock; `DataWriter.write` keeps that lock while it delivers to readers of the same process. So two links of
one process to one domain, and a third program, would sooner or later wait for each other for ever.
"""

from collections.abc import Callable
from dataclasses import dataclass
from threading import Thread
from typing import Any

from cyclonedds.core import DDSStatus, GuardCondition, WaitSet
from cyclonedds.domain import DomainParticipant
from cyclonedds.sub import DataReader
from cyclonedds.util import duration

from tfbus.links.dds._joining import delete

_FOR_EVER = duration(infinite=True)


@dataclass(frozen=True, slots=True)
class _Watched:
    reader: DataReader[Any]
    take: Callable[[DataReader[Any]], object]
    match: Callable[[DataReader[Any]], object] | None


class ReaderThread:
    """Waits for the readers of a participant, and calls functions, in a thread of its own.

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

    def watch(
        self,
        reader: DataReader[Any],
        take: Callable[[DataReader[Any]], object],
        match: Callable[[DataReader[Any]], object] | None = None,
    ) -> None:
        """Call `take` when a reader has data, and `match` when its writers have changed; before `start`."""
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
            self._waiting.wait(_FOR_EVER)
            if self._stopped.read():
                return
            for watched in self._watched:
                try:
                    _serve(watched)
                except Exception as error:  # noqa: BLE001 - nothing that others send may end the thread
                    self._failed(error)


def _serve(watched: _Watched) -> None:
    # Before the data are taken: what comes later is told again.
    told = watched.reader.take_status()
    if watched.match is not None and told & DDSStatus.SubscriptionMatched:
        watched.match(watched.reader)
    if told & DDSStatus.DataAvailable:
        watched.take(watched.reader)
