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

import anyio
import anyio.to_thread
import zenoh
from anyio.abc import TaskGroup

from tfbus.links._message import Message
from tfbus.links._receive_queue import Presence, Received
from tfbus.links.zenoh._dialing import Dialing, is_reachable
from tfbus.links.zenoh._filters import Filters
from tfbus.links.zenoh._hearing import DEAF, Hearing
from tfbus.links.zenoh._introductions import Introductions
from tfbus.links.zenoh._keys import FIRST_SESSION, Keys
from tfbus.links.zenoh._listening import Listening
from tfbus.links.zenoh._notes import MOST_ASKING, MOST_NOTED, Noted, Notes
from tfbus.links.zenoh._opening import OpenQuestion, guarded, refusal
from tfbus.links.zenoh._patch import Patch
from tfbus.links.zenoh._present import Present
from tfbus.links.zenoh._session import ZenohSession
from tfbus.links.zenoh._unmet import Unmet
from tfbus.tf_message import MalformedMessageError

_MEETING_TIME = 10.0
"""s that a peer has to be met where it was dialled; on a busy machine that takes more than three."""


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
        self._notes = Notes(monotonic, self._refuse_note)
        self._filters = Filters(keys.robot)
        self._unserved: set[str] = set()
        self._present = Present(receive, self._notes.add_change)
        notes = self._note_asked, self._notes.add_connection, self._note_heard, self._filters, self._note_served
        self._main = ZenohSession(
            config, keys, receive, self._note_directly, FIRST_SESSION, *notes, self._present.robot
        )
        self._patches: dict[str, Patch] = {}
        self._dialing = Dialing(monotonic) if dialing is None else dialing
        self._hearing = Hearing(monotonic)
        self._unmet = Unmet(self._main, keys, monotonic)
        self._listening = Listening(config)
        self._introductions = Introductions(keys, self._listening, self._dialing, monotonic)
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
        if self._present and not self._filters.cover(self._present):
            return True
        return any(session.publishers.is_heard() for session in self._open())

    def is_heard_slowly(self) -> bool:
        """Whether anybody subscribes to the slow key."""
        return any(session.publishers.is_heard_slowly() for session in self._open())

    def ask(self, peer: str, since: int) -> None:
        """Ask a peer for the changes of its state behind a number."""
        self._to(peer).ask(peer, since, heard=self._present.is_direct(peer))

    def ask_history(self, peer: str, seconds: float, after: str) -> None:
        """Ask a peer for the last seconds of its moving frames."""
        self._to(peer).ask_history(peer, seconds, after)

    def _to(self, peer: str) -> ZenohSession:
        patch = self._patches.get(peer)
        return patch if patch is not None and patch.is_open else self._main

    def answer(self, question: OpenQuestion, message: Message) -> None:
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
                try:
                    await self._look_after(self._notes.take(), late, tasks)
                except Exception as error:  # noqa: BLE001 - no peer may end the link
                    self._receive(refusal(error))

    async def _look_after(self, noted: Noted, late: bool, tasks: TaskGroup) -> None:
        """Do what the notes ask for, and what is due; `late` is whether this loop has had no time."""
        connected = [self._reached(*connection) for connection in noted.connected]
        self._note(noted.changes)
        for peer, _ in connected:
            if self._present.is_direct(peer):
                self._hearing.joined(peer)
        for peer in noted.hearers:
            self._hearing.is_heard(peer)
        for peer, names, named in noted.heard_by:
            # Where this loop has no time, nobody's silence proves anything, and many have not come yet.
            if names is not None or not late:
                self._judge(peer, names)
            if not late:
                guarded(self._receive, peer, self._introductions.take, named, self._present)
        # Before all that may wait for zenoh; who is due after this is dialled in the next round.
        self._dial(self._dialing.take_due(), tasks)
        if noted.asking:
            self._answer_hearing(noted.asking)
        if self._keys.filter:
            self._hear_unserved()
        for peer in self._hearing.take_due():
            self._main.ask_hearing(peer, partial(self._notes.add_answer, peer))
        self._ask_for_missing()
        self._closing = [closing for closing in self._closing if closing.is_alive()]
        unmet = await self._unmet.find(connected, self._present, self._dialing.is_dialled)
        self._dial(unmet, tasks)

    def _reached(self, peer: str, near: str, far: str) -> tuple[str, str | None]:
        """Note a connection that has come or gone; returns where the peer listens, or None if it has dialled."""
        address = far if self._listening.is_dialled(near, far) else None
        if address is not None:
            self._dialing.reached(peer, address)
        return peer, address

    def _dial(self, due: Iterable[tuple[str, str]], tasks: TaskGroup) -> None:
        for peer, address in due:
            if peer not in self._patches:
                tasks.start_soon(self._patch, peer, address)

    def _next_due(self) -> float:
        """The time at which somebody is to be asked or dialled."""
        parts = (self._hearing, self._dialing, self._unmet, self._introductions)
        return min((time for part in parts if (time := part.next_due()) is not None), default=math.inf)

    def _ask_for_missing(self) -> None:
        """Ask one of the peers for those that this link has not met."""
        peer = self._introductions.take_due(self._present, self._answers)
        if peer is not None:
            known = self._introductions.question(self._present)
            self._to(peer).ask_hearing(peer, partial(self._notes.add_answer, peer), known)

    def _answers(self, peer: str) -> bool:
        """Whether a peer can answer here; by its patches, it does not."""
        return self._present.is_direct(peer) or peer in self._patches

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
        if changes:
            self._introductions.changed()
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
            if self._present.is_direct(peer):
                self._hearing.joined(peer)
                if peer not in self._deaf:
                    self._drop_patch(peer)

    def _judge(self, peer: str, names: list[str] | None) -> None:
        """Note which sessions of this link a peer hears, and have it dialled if there is none."""
        if names and FIRST_SESSION in names and peer in self._deaf:
            self._deaf.discard(peer)
            self._dialing.joined(peer)
            if self._present.is_direct(peer):
                self._drop_patch(peer)
        if names is None:
            deaf = self._present.is_direct(peer) and self._hearing.is_silent(peer)
        else:
            deaf = self._hearing.is_deaf(peer, bool(names))
        if deaf:
            self._deaf.add(peer)
            self._drop_patch(peer)
            self._dialing.left(peer)

    def _answer_hearing(self, asking: Iterable[zenoh.Query]) -> None:
        answers = [(query, self._names_heard(query), self._named(query)) for query in asking]
        self._note_unheard(answers)
        # While zenoh waits for a peer that is frozen, others ask again.
        if self._hearing_answers is None or self._hearing_answers.done():
            self._hearing_answers = self._answering.submit(self._main.answer_hearing, answers)
            self._hearing_answers.add_done_callback(_log_failure)

    def _note_unheard(self, answers: Iterable[tuple[zenoh.Query, list[str], bytes]]) -> None:
        """Dial those that have asked several times whether they are heard, and are not."""
        for query, names, _ in answers:
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
        """The sessions, by their names, that are heard of the link that asks."""
        return self._present.names(self._asker(query) or "")

    def _named(self, query: zenoh.Query) -> bytes:
        """The peers that the link that asks has not met."""
        asker = self._asker(query)
        if asker is None or query.attachment is None:
            return b""
        known, answer = query.attachment.to_bytes(), self._introductions.answer
        return guarded(self._receive, asker, answer, known, asker, self._present.robots()) or b""

    def _asker(self, query: zenoh.Query) -> str | None:
        """The link that asks whether it is heard; None for one that this link does not mean to hear."""
        return self._keys.heard_link(b"" if query.payload is None else query.payload.to_bytes())

    def _note_asked(self, query: zenoh.Query) -> None:
        self._keys.check_token(b"" if query.payload is None else query.payload.to_bytes())
        if self._asker(query) is None:
            # It is not meant to be heard.
            query.drop()
        elif not self._notes.add_question(query):
            raise MalformedMessageError("busy", f"{MOST_ASKING} links ask whether they are heard")

    def _note_heard(self, token: bytes) -> None:
        self._keys.check_token(token)
        peer = self._keys.heard_link(token)
        if peer is not None:
            self._notes.add_hearer(peer)

    async def _patch(self, peer: str, address: str) -> None:
        try:
            await self._dial_and_meet(peer, address)
        except Exception as error:  # noqa: BLE001 - no address that a peer names may end the link
            self._drop_patch(peer)
            self._dialing.taken(peer, address)
            self._receive(refusal(error, peer))

    async def _dial_and_meet(self, peer: str, address: str) -> None:
        try:
            reachable = await is_reachable(address)
        except ConnectionRefusedError:
            self._dialing.refused(peer, address)
            return
        if not reachable or peer in self._patches:
            return
        config = self._patch_config(address)
        notes = self._note_by_patch, self._filters, self._note_served, self._present.robot
        patch = Patch(config, self._keys, peer, self._receive, *notes)
        self._patches[peer] = patch
        try:
            await anyio.to_thread.run_sync(patch.open, abandon_on_cancel=True)
        except (OSError, zenoh.ZError):
            # It may also have been lost while it began.
            self._drop_patch(peer)
            return
        await patch.meet(lambda: peer in self._present, _MEETING_TIME)
        found = patch.found_instead()
        if peer not in self._present and found is not None:
            self._dialing.taken(peer, address)
            self._note_found(*found, address)
        if peer not in self._present or (self._present.is_direct(peer) and peer not in self._deaf):
            self._drop_patch(peer)

    def _note_found(self, session: str, is_link: bool, address: str) -> None:
        """Note who is at an address where another one was looked for."""
        if session == self._keys.link:
            return
        self._dialing.reached(session, address)
        if not is_link:
            self._unmet.connected(session, address)
        elif session not in self._present:
            self._dialing.left(session)

    def _drop_patch(self, peer: str) -> None:
        patch = self._patches.pop(peer, None)
        if patch is not None:
            self._closing.append(patch.close())
            # It will not tell any more.
            self._present.end(peer, patch)
            self._filters.lose(patch)

    def _note_by_patch(self, patch: Patch, name: str, presence: Presence, robot: str) -> None:
        if presence is Presence.LEFT or self._patches.get(patch.peer) is patch:
            self._present.note(patch.peer, (patch, name), presence, robot)

    def _note_directly(self, link: str, name: str, presence: Presence, robot: str) -> None:
        self._present.note(link, (None, name), presence, robot)

    def _refuse_note(self) -> None:
        detail = f"more than {MOST_NOTED} peers or connections have come or gone before this link has looked"
        self._receive(Received("", MalformedMessageError("too many tokens", detail)))

    def _note_served(self, peer: str, served: bool) -> None:
        with self._lock:
            changed = served is (peer in self._unserved)
            (self._unserved.discard if served else self._unserved.add)(peer)
        if changed and self._keys.filter:
            self._notes.stir()


def _log_failure(answer: Future[None]) -> None:
    if not answer.cancelled() and answer.exception() is not None:
        logging.getLogger("tfbus").error("an answer could not be sent", exc_info=answer.exception())
