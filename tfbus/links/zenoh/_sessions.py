"""All zenoh sessions of a link: the one that it was opened with, and one for each peer that only another way reaches.

Peers in a mesh hear each other over direct connections only. When one of these breaks, while both ends are well with
others, zenoh does not dial again. Then a session of its own does, the *patch*, which is connected to nobody else. The
same mends a connection of which only one end hears the other; see `tfbus.links.zenoh._hearing`. Both ends dial then:
one of them has accepted the connection, and knows no address at which the other one listens.
"""

import logging
import math
import threading
from collections import Counter
from collections.abc import Callable, Container, Iterable, Mapping, Set
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from time import monotonic
from uuid import uuid4

import anyio
import anyio.to_thread
import zenoh
from anyio.abc import TaskGroup

from tfbus.links._message import Message
from tfbus.links._receive_queue import Presence, Received
from tfbus.links.zenoh._dialing import Dialing, is_reachable
from tfbus.links.zenoh._filters import Filters
from tfbus.links.zenoh._hearing import DEAF, Hearing
from tfbus.links.zenoh._keys import FIRST_SESSION, Keys
from tfbus.links.zenoh._notes import MOST_ASKING, Notes
from tfbus.links.zenoh._session import ZenohSession
from tfbus.links.zenoh._unmet import Unmet

_MEETING_TIME = 10.0
"""s that a peer has to be met where it was dialled; on a busy machine that takes more than three."""

_Way = tuple[ZenohSession | None, str]
"""A connection between two links: the patch here, or None for the first session, and the name of the session there."""


class ZenohSessions:
    """The sessions of one link; peers are present while one of the sessions says so.

    Parameters
    ----------
    config : zenoh.Config
    patch_config : callable
        The configuration of a session that connects to one address only.
    keys : Keys
    receive : callable
        Called in any thread with each `Received` item.
    dialing : Dialing, optional
        Decides whom to dial when.
    """

    def __init__(
        self,
        config: zenoh.Config,
        patch_config: Callable[[str], zenoh.Config],
        keys: Keys,
        receive: Callable[[Received], object],
        dialing: Dialing | None = None,
    ) -> None:
        self._patch_config = patch_config
        self._keys = keys
        self._receive = receive
        self._lock = threading.Lock()
        self._notes = Notes(monotonic)
        self._filters = Filters(keys.robot)
        self._unserved: set[str] = set()
        self._main = ZenohSession(
            config,
            keys,
            receive,
            self._note_directly,
            note_asked=self._note_asked,
            note_connection=self._notes.add_connection,
            note_heard=self._note_heard,
            filters=self._filters,
            note_served=self._note_served,
        )
        self._patches: dict[str, ZenohSession] = {}
        self._present: dict[str, set[_Way]] = {}
        self._dialing = Dialing(monotonic) if dialing is None else dialing
        self._hearing = Hearing(monotonic)
        self._unmet = Unmet(self._main, keys, monotonic)
        self._deaf: set[str] = set()
        self._unheard: Counter[str] = Counter()
        self._closing: list[threading.Thread] = []
        # Not a task that waits for a worker thread: where nobody has time, it would come to its next answers seconds
        # later.
        self._answering = ThreadPoolExecutor(1, thread_name_prefix="tfbus answers")
        self._hearing_answers: Future[None] | None = None

    @property
    def session(self) -> zenoh.Session:
        """The session of zenoh that the link was opened with."""
        return self._main.session

    def open(self) -> None:
        """Open the session; for a worker thread.

        Raises
        ------
        OSError
            If it cannot listen where it should, or as a client reaches nobody.
        """
        self._main.open()

    def put(self, message: Message) -> None:
        """Send a live message, or drop it while the network is congested; raises `zenoh.ZError`."""
        for session in self._open():
            session.publishers.put(message)

    @property
    def filters(self) -> Mapping[str, Set[str]]:
        """The frames that peers with a filter want, by the name of the filter; another object after each change."""
        return self._filters.wanted

    def put_part(self, name: str, message: Message) -> None:
        """Send a live message to the peers that have the filter of a name; raises `zenoh.ZError`."""
        for session in self._open():
            session.publishers.put_part(name, message)

    def serve(self, names: Container[str]) -> None:
        """Send nothing any more for filters but those of some names."""
        for session in self._open():
            session.publishers.serve(names)

    def put_slowly(self, messages: Iterable[Message]) -> None:
        """Send messages by the slow key of each session that somebody hears there; raises `zenoh.ZError`."""
        hearing = [session for session in self._open() if session.publishers.is_heard_slowly()]
        for message in messages:
            for session in hearing:
                session.publishers.put_slowly(message)

    def is_heard(self) -> bool:
        """Whether a peer without a filter is there, or anybody subscribes to the live key; raises `zenoh.ZError`."""
        with self._lock:
            heard = bool(self._present) and not self._filters.cover(self._present)
        return heard or any(session.publishers.is_heard() for session in self._open())

    def is_heard_slowly(self) -> bool:
        """Whether anybody subscribes to the slow key."""
        return any(session.publishers.is_heard_slowly() for session in self._open())

    def ask(self, peer: str, since: int) -> None:
        """Ask a peer for the changes of its state behind a number."""
        self._to(peer).ask(peer, since, heard=self._is_direct(peer))

    def ask_history(self, peer: str, seconds: float, after: str) -> None:
        """Ask a peer for the last seconds of its moving frames."""
        self._to(peer).ask_history(peer, seconds, after)

    def _to(self, peer: str) -> ZenohSession:
        patch = self._patches.get(peer)
        return patch if patch is not None and patch.is_open else self._main

    def answer(self, question: zenoh.Query, message: Message) -> None:
        """Answer a question, in a thread, because zenoh may wait for a peer that is frozen."""
        self._answering.submit(self._main.answer, question, message).add_done_callback(_log_failure)

    def _open(self) -> list[ZenohSession]:
        return [self._main, *(patch for patch in tuple(self._patches.values()) if patch.is_open)]

    def close(self) -> list[threading.Thread]:
        """Begin to close all sessions; returns threads that end when they are closed."""
        self._answering.shutdown(wait=False, cancel_futures=True)
        sessions = [self._main, *self._patches.values()]
        self._patches.clear()
        return [*self._closing, *(session.close() for session in sessions)]

    async def keep_connected(self, interval: float = 0.25) -> None:
        """Dial peers that were lost, or do not hear this link, until cancelled.

        What comes within an `interval`, in s, is looked after together; while nothing comes or is due, nothing is done.
        """
        self._notes.bind()
        async with anyio.create_task_group() as tasks:
            while True:
                await self._notes.wait(self._next_due())
                began = monotonic()
                await anyio.sleep(interval)
                late = monotonic() - min(began, self._notes.since) > 3 * interval
                noted = self._notes.take()
                for peer, address in noted.connected:
                    self._dialing.reached(peer, address)
                self._note(noted.changes)
                for peer, _ in noted.connected:
                    if self._is_direct(peer):
                        self._hearing.joined(peer)
                for peer in noted.hearers:
                    self._hearing.is_heard(peer)
                for peer, names in noted.heard_by:
                    # Where this loop has no time, nobody's silence proves anything.
                    if names is not None or not late:
                        self._judge(peer, names)
                # Before all that may wait for zenoh; who is due after this is dialled in the next round.
                self._dial(self._dialing.take_due(), tasks)
                if noted.asking:
                    self._answer_hearing(noted.asking)
                if self._keys.filter:
                    self._hear_unserved()
                for peer in self._hearing.take_due():
                    self._main.ask_hearing(peer, partial(self._notes.add_answer, peer))
                self._closing = [closing for closing in self._closing if closing.is_alive()]
                unmet = await self._unmet.find(noted.connected, self._present, self._dialing.is_dialled)
                self._dial(unmet, tasks)

    def _dial(self, due: Iterable[tuple[str, str]], tasks: TaskGroup) -> None:
        for peer, address in due:
            if peer not in self._patches:
                tasks.start_soon(self._patch, peer, address)

    def _next_due(self) -> float:
        """The time at which somebody is to be asked or dialled."""
        times = (self._hearing.next_due(), self._dialing.next_due(), self._unmet.next_due())
        return min((time for time in times if time is not None), default=math.inf)

    def _hear_unserved(self) -> None:
        """Hear the live keys of peers that do not serve this link's filter, by the last answer of each."""
        with self._lock:
            self._unserved &= self._present.keys()
            unserved = frozenset(self._unserved)
        for session in self._open():
            try:
                session.hear_all_of(unserved)
            except zenoh.ZError:
                # It is declared later, or the session has ended.
                self._notes.stir()

    def _note(self, changes: list[tuple[str, Presence]]) -> None:
        for peer, presence in changes:
            if presence is Presence.LEFT:
                if peer not in self._present:
                    self._dialing.left(peer)
                    self._hearing.left(peer)
                    self._deaf.discard(peer)
                    self._drop_patch(peer)
            else:
                self._dialing.joined(peer)
        for peer in {peer for peer, presence in changes if presence is Presence.JOINED}:
            # A connection is not enough: zenoh may have it, and tell nothing of the other end.
            if self._is_direct(peer):
                self._hearing.joined(peer)
                if peer not in self._deaf:
                    self._drop_patch(peer)

    def _is_direct(self, peer: str) -> bool:
        return (None, FIRST_SESSION) in self._present.get(peer, ())

    def _judge(self, peer: str, names: list[str] | None) -> None:
        """Note which sessions of this link a peer hears, and have it dialled if there is none."""
        if names and FIRST_SESSION in names and peer in self._deaf:
            self._deaf.discard(peer)
            self._dialing.joined(peer)
            if self._is_direct(peer):
                self._drop_patch(peer)
        if names is None:
            deaf = self._is_direct(peer) and self._hearing.is_silent(peer)
        else:
            deaf = self._hearing.is_deaf(peer, bool(names))
        if deaf:
            self._deaf.add(peer)
            self._drop_patch(peer)
            self._dialing.left(peer)

    def _answer_hearing(self, asking: Iterable[zenoh.Query]) -> None:
        with self._lock:
            answers = [(query, self._names_heard(query)) for query in asking]
        self._note_unheard(answers)
        # While zenoh waits for a peer that is frozen, others ask again.
        if self._hearing_answers is None or self._hearing_answers.done():
            self._hearing_answers = self._answering.submit(self._main.answer_hearing, answers)
            self._hearing_answers.add_done_callback(_log_failure)

    def _note_unheard(self, answers: Iterable[tuple[zenoh.Query, list[str]]]) -> None:
        """Dial those that have asked several times whether they are heard, and are not."""
        for query, names in answers:
            asker = self._asker(query)
            if asker is None or names:
                self._unheard.pop(asker or "", None)
            else:
                self._unheard[asker] += 1
                if self._unheard[asker] >= DEAF and not self._dialing.is_dialled(asker):
                    self._dialing.left(asker)
        if len(self._unheard) > MOST_ASKING:
            self._unheard.clear()

    def _names_heard(self, query: zenoh.Query) -> list[str]:
        """The sessions, by their names, that are heard of the link that asks; the lock is held."""
        asker = self._asker(query)
        return sorted({name for _, name in self._present.get(asker or "", ())})

    def _asker(self, query: zenoh.Query) -> str | None:
        """The link that asks whether it is heard; None for one that this link does not mean to hear."""
        return self._keys.heard_link(b"" if query.payload is None else query.payload.to_bytes())

    def _note_asked(self, query: zenoh.Query) -> None:
        if self._asker(query) is None or not self._notes.add_question(query):
            query.drop()

    def _note_heard(self, token: bytes) -> None:
        peer = self._keys.heard_link(token)
        if peer is not None:
            self._notes.add_hearer(peer)

    async def _patch(self, peer: str, address: str) -> None:
        try:
            reachable = await is_reachable(address)
        except ConnectionRefusedError:
            self._dialing.refused(peer, address)
            return
        if not reachable or peer in self._patches:
            return
        patch = ZenohSession(
            self._patch_config(address),
            self._keys,
            lambda item: self._receive_by_patch(item, peer),
            lambda link, name, presence: self._note_by_patch(link, name, presence, peer, patch),
            uuid4().hex,
            filters=self._filters,
            note_served=self._note_served,
        )
        self._patches[peer] = patch
        try:
            await anyio.to_thread.run_sync(patch.open, abandon_on_cancel=True)
        except (OSError, zenoh.ZError):
            # It may also have been lost while it began.
            self._drop_patch(peer)
            return
        with anyio.move_on_after(_MEETING_TIME):
            while peer not in self._present:  # noqa: ASYNC110 - zenoh's threads wake no event here
                await anyio.sleep(0.05)
        if peer not in self._present:
            found = await anyio.to_thread.run_sync(patch.addresses)
            if found and peer not in found:
                self._dialing.taken(peer, address)
        if peer not in self._present or (self._is_direct(peer) and peer not in self._deaf):
            self._drop_patch(peer)

    def _drop_patch(self, peer: str) -> None:
        patch = self._patches.pop(peer, None)
        if patch is not None:
            self._closing.append(patch.close())
            with self._lock:
                ways = [way for way in self._present.get(peer, ()) if way[0] is patch]
            for way in ways:
                # It will not tell any more.
                self._note_presence(peer, way, Presence.LEFT)
            self._filters.lose(patch)

    def _receive_by_patch(self, item: Received, peer: str) -> None:
        # Somebody else may be at that address now.
        if item.sender in ("", peer):
            self._receive(item)

    def _note_by_patch(self, link: str, name: str, presence: Presence, peer: str, patch: ZenohSession) -> None:
        if link == peer and (presence is Presence.LEFT or self._patches.get(peer) is patch):
            self._note_presence(peer, (patch, name), presence)

    def _note_served(self, peer: str, served: bool) -> None:
        with self._lock:
            changed = served is (peer in self._unserved)
            (self._unserved.discard if served else self._unserved.add)(peer)
        if changed and self._keys.filter:
            self._notes.stir()

    def _note_directly(self, link: str, name: str, presence: Presence) -> None:
        self._note_presence(link, (None, name), presence)

    def _note_presence(self, peer: str, way: _Way, presence: Presence) -> None:
        with self._lock:
            ways = self._present.setdefault(peer, set())
            was_present = bool(ways)
            if presence is Presence.JOINED:
                ways.add(way)
            else:
                ways.discard(way)
            is_present = bool(ways)
            if not is_present:
                del self._present[peer]
            if is_present is not was_present:
                self._receive(Received(peer, presence))
            if is_present is not was_present or way == (None, FIRST_SESSION):
                self._notes.add_change(peer, presence)


def _log_failure(answer: Future[None]) -> None:
    if not answer.cancelled() and answer.exception() is not None:
        logging.getLogger("tfbus").error("an answer could not be sent", exc_info=answer.exception())
