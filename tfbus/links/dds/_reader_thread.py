"""`ReaderThread`, which hands on what the readers of a DDS participant receive.

There are no listeners. The library calls one while it keeps its reader, and a listener in Python first waits for the
interpreter lock; `DataWriter.write` keeps that lock while it delivers to readers of the same process. So two links of
one process to one domain, and a third program, would sooner or later wait for each other for ever.
"""

from collections.abc import Callable
from dataclasses import dataclass
from math import inf
from threading import Thread
from time import monotonic, sleep
from typing import Any

from cyclonedds.core import DDSStatus, GuardCondition, WaitSet
from cyclonedds.domain import DomainParticipant
from cyclonedds.sub import DataReader
from cyclonedds.util import duration

from tfbus.links.dds._joining import delete

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
