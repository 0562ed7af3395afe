"""One zenoh session of a link: its keys, and what zenoh's threads receive."""

import struct
import threading
import weakref
from collections.abc import Callable, Iterable, Set
from concurrent.futures import Future
from contextlib import suppress
from time import monotonic
from typing import Any

import zenoh

from tfbus.links._history import LONGEST_HISTORY
from tfbus.links._message import MAX_BYTES, Message
from tfbus.links._receive_queue import Answer, HistoryAnswer, HistoryQuestion, Presence, Question, Received
from tfbus.links.zenoh._closing import begin_to_close, close_session
from tfbus.links.zenoh._filters import Filters
from tfbus.links.zenoh._keys import ANY_ROBOT, FIRST_SESSION, Keys
from tfbus.links.zenoh._newest import Thinning
from tfbus.links.zenoh._opening import OpenQuestion, directly, open_session, refusal
from tfbus.links.zenoh._publishers import Publishers
from tfbus.tf_message import MalformedMessageError

_LONGEST_SHOWN_KEY = 200
MOST_QUESTIONS = 1_000
MOST_NAMES = 1_000
"""Bytes; so much is read of an answer with names of sessions."""
_ANSWER_TIME = 10.0
"""s; an answer that comes late is as good, so it is longer than the asker's patience."""
_HEARING_TIME = 1.0
_URGENT = zenoh.Priority.INTERACTIVE_HIGH
"""Of questions whether a link is heard, and so of their answers: they overtake live messages, and are dropped last."""
_SINCE = struct.Struct("<Q")
_SECONDS = struct.Struct("<d")
_LONGEST_NAME = 2**16
_SERVES_FILTERS = "tfbus/state;filters"
"""The encoding of answers of a link that sends those who hear only some frames no more than these."""


class ZenohSession:
    """A session and its keys: `open` and `answer` block; `ask` and `close` do not.

    Parameters
    ----------
    config : zenoh.Config
    keys : Keys
    receive : callable
        Called in zenoh's threads with each `Received` item but presence; a message's content is a payload and its
        attachment.
    note_presence : callable
        Called in zenoh's threads with a link, the name of a session of it, its `Presence`, and the robot of the link.
    note_asked : callable, optional
        Called in zenoh's threads with each query of a link that asks whether it is heard; without it, none is answered.
    note_connection : callable, optional
        Called in zenoh's threads with each connection that is made or breaks: the session at the far end, the address
        of the near end, and that of the far end.
    note_heard : callable, optional
        Called in zenoh's threads with the token of each link that tells that it hears this one.
    filters : Filters, optional
        Is told of the filters of other links.
    note_served : callable, optional
        Called in zenoh's threads with each link that has answered a question, and whether it serves this link's filter.
    robot_of : callable, optional
        Returns the robot of a link, or `ANY_ROBOT`.
    name : str
        The name of this session among those of the link.

    Attributes
    ----------
    is_open : bool
    publishers : Publishers
        While it is open.
    """

    def __init__(
        self,
        config: zenoh.Config,
        keys: Keys,
        receive: Callable[[Received], object],
        note_presence: Callable[[str, str, Presence, str], object],
        name: str = FIRST_SESSION,
        note_asked: Callable[[zenoh.Query], object] | None = None,
        note_connection: Callable[[str, str, str], object] | None = None,
        note_heard: Callable[[bytes], object] | None = None,
        filters: Filters | None = None,
        note_served: Callable[[str, bool], object] = lambda *_: None,
        robot_of: Callable[[str], str] = lambda _: ANY_ROBOT,
    ) -> None:
        self._config = config
        self._note_presence = note_presence
        self._note_asked = note_asked
        self._note_connection = note_connection
        self._note_heard = note_heard
        self._filters = Filters(keys.robot) if filters is None else filters
        self._note_served = note_served
        self._robot_of = robot_of
        self._unfiltered: dict[str, zenoh.Subscriber[None]] = {}
        self._name = name
        self._keys = keys
        self._receive = receive
        self._lock = threading.Lock()
        self._closed = False
        self._session: zenoh.Session | None = None
        self.is_open = False
        self._declared: list[object] = []
        self._questions = weakref.WeakSet[OpenQuestion]()
        self._close_at_exit: weakref.finalize[..., ZenohSession] | None = None

    def open(self) -> None:
        """Open the session and announce the link.

        Raises
        ------
        OSError
            If it cannot listen where it should, or as a client reaches nobody; with its `errno`, if there is one.
        """
        opened: Future[None] = Future()

        def complete() -> None:
            try:
                self._open()
            except BaseException as error:  # noqa: BLE001 - the waiting thread raises it
                opened.set_exception(error)
            else:
                opened.set_result(None)

        # A worker thread of trio is a daemon: the interpreter would end without it, and zenoh then aborts the process.
        threading.Thread(target=complete, daemon=False).start()
        opened.result()

    def _open(self) -> None:
        session = open_session(self._config)
        with self._lock:
            self._session = session
            abandoned = self._closed
        if abandoned:
            close_session(session)
            return
        # A program may exit without the end of its link. A callback of zenoh while the interpreter ends is an abort.
        self._close_at_exit = weakref.finalize(self, close_session, session)
        remote, keys = zenoh.Locality.REMOTE, self._keys
        self.publishers = Publishers(session, keys)
        # A peer that sees the token can ask at once. zenoh undeclares a token that nobody refers to.
        self._declared = [
            *(
                session.declare_subscriber(key, self._door(self._receive_live), allowed_origin=remote)
                for key in keys.heard("live")
            ),
            *(
                session.declare_subscriber(key, self._door(self._receive_slow(rate)), allowed_origin=remote)
                for key, rate in keys.slow()
            ),
            # Before presence, so that what goes to a peer is known when the peer is.
            session.liveliness().declare_subscriber(
                keys.filter_tokens(), self._door(self._receive_filter), history=True
            ),
            *(
                session.liveliness().declare_subscriber(key, self._door(self._receive_presence), history=True)
                for key in keys.heard("@alive")
            ),
            session.declare_queryable(keys.own("state"), self._door(self._receive_question)),
            session.declare_queryable(keys.own("history"), self._door(self._receive_history_question)),
            *([session.declare_queryable(keys.own("hears"), self._door(self._note_asked))] if self._note_asked else []),
            *([session.liveliness().declare_token(keys.filter_token(self._name))] if keys.filter else []),
            session.liveliness().declare_token(keys.token(self._name)),
        ]
        if self._note_connection is not None:
            listener = session.info.declare_link_events_listener(self._door(self._receive_connection), history=True)
            self._declared.append(listener)
        self.is_open = True

    @property
    def session(self) -> zenoh.Session:
        """The session of zenoh, once it is open."""
        assert self._session is not None
        return self._session

    def hear_all_of(self, peers: Set[str]) -> None:
        """Hear the live keys of some peers, and of no others; for a link with a filter."""
        for peer in self._unfiltered.keys() - peers:
            # zenoh goes on calling a callback of which nobody has the subscriber.
            self._unfiltered.pop(peer).undeclare()
        for peer in peers - self._unfiltered.keys():
            self._unfiltered[peer] = self.session.declare_subscriber(
                self._keys.of("live", peer, ANY_ROBOT),
                self._door(self._receive_all),
                allowed_origin=zenoh.Locality.REMOTE,
            )

    def connected(self) -> set[str]:
        """The directly connected sessions; may block."""
        try:
            return {str(link.zid) for link in self.session.info.links()}
        except zenoh.ZError:
            return set()

    def routers(self) -> list[str]:
        """The sessions of directly connected routers; may block."""
        try:
            return [str(router) for router in self.session.info.routers_zid()]
        except zenoh.ZError:
            return []

    def ask(self, peer: str, since: int, heard: bool = False) -> None:
        """Ask a peer for the changes of its state behind a number; the answer is received as an item.

        With `heard`, the peer is also told that this link hears it.
        """
        self._ask("state", peer, _SINCE.pack(since), Answer, heard)

    def ask_history(self, peer: str, seconds: float, after: str) -> None:
        """Ask a peer for the last seconds of its moving frames behind a name; the answer is received as an item."""
        self._ask("history", peer, _SECONDS.pack(seconds) + after.encode(), HistoryAnswer)

    def _ask(
        self, kind: str, peer: str, payload: bytes, answer: type[Answer | HistoryAnswer], heard: bool = False
    ) -> None:
        answered = False

        def take(reply: zenoh.Reply) -> None:
            nonlocal answered
            if reply.ok is not None and not answered:
                answered = True
                if answer is Answer:
                    self._note_served(peer, str(reply.ok.encoding) == _SERVES_FILTERS)
                self._receive_message(peer, reply.ok, answer)

        def end() -> None:
            if not answered:
                self._receive(Received(peer, answer(None)))

        try:
            self.session.get(
                self._key(kind, peer),
                self._door(take, end),
                payload=payload,
                consolidation=zenoh.ConsolidationMode.NONE,
                timeout=_ANSWER_TIME,
                congestion_control=zenoh.CongestionControl.DROP,
                # At the priority of live messages, for an answer that overtook one would split its batch.
                attachment=self._keys.token(FIRST_SESSION) if heard else None,
            )
        except zenoh.ZError:
            self._receive(Received(peer, answer(None)))

    def ask_hearing(self, peer: str, take: Callable[[list[str] | None, bytes], object], known: bytes = b"") -> None:
        """Ask a peer which sessions of this link it hears, and whom it knows beside those that are `known`.

        `take` is called in zenoh's threads, with None for no answer, and with what the peer has answered to `known`.
        """
        answered = False

        def take_reply(reply: zenoh.Reply) -> None:
            nonlocal answered
            if reply.ok is not None and not answered:
                answered = True
                names = reply.ok.payload.to_bytes()[:MOST_NAMES].decode("ascii", "replace")
                named = b"" if reply.ok.attachment is None else reply.ok.attachment.to_bytes()
                take(names.split(",") if names else [], named)

        def end() -> None:
            if not answered:
                take(None, b"")

        # A question that cannot be sent is sent again.
        with suppress(zenoh.ZError):
            self.session.get(
                self._key("hears", peer),
                self._door(take_reply, end),
                payload=self._keys.token(FIRST_SESSION),
                timeout=_HEARING_TIME,
                congestion_control=zenoh.CongestionControl.DROP,
                priority=_URGENT,
                attachment=known or None,
            )

    def answer_hearing(self, answers: Iterable[tuple[zenoh.Query, list[str], bytes]]) -> None:
        """Answer links that ask whether they are heard, and whom this link knows; may block, as `answer`."""
        for query, names, named in answers:
            with suppress(zenoh.ZError):
                query.reply(self._keys.own("hears"), ",".join(names)[:MOST_NAMES], attachment=named or None)
            query.drop()

    def answer(self, question: OpenQuestion, message: Message) -> None:
        """Answer a question; may block, because zenoh waits for a peer whose queue is full."""
        encoding = zenoh.Encoding(_SERVES_FILTERS) if self._filters.are_served else None
        key = self._keys.own(question.kind)
        try:
            # A peer that has gone needs no answer.
            with suppress(zenoh.ZError):
                question.query.reply(key, message.payload, attachment=message.attachment, encoding=encoding)
        finally:
            question.drop()
            self._questions.discard(question)

    def close(self) -> threading.Thread:
        """Begin to close the session, also one that is still being opened.

        Returns
        -------
        threading.Thread
            Ends when the session is closed: within milliseconds, or after 10 s if a peer is frozen.
        """
        with self._lock:
            self._closed = True
            session = self._session
        if self._close_at_exit is not None:
            self._close_at_exit.detach()
        return begin_to_close(session)

    def _receive_live(self, sample: zenoh.Sample) -> None:
        # A peer that does not serve this link's filter is heard by its live key.
        sender = self._sender(sample, "only" if self._keys.filter else "live")
        if sender is not None and sample.kind == zenoh.SampleKind.PUT and sender not in self._unfiltered:
            self._receive_message(sender, sample)

    def _receive_all(self, sample: zenoh.Sample) -> None:
        sender = self._sender(sample, "live")
        if sender is not None and sample.kind == zenoh.SampleKind.PUT:
            self._receive_message(sender, sample)

    def _receive_slow(self, rate: float) -> Callable[[zenoh.Sample], None]:
        thinning = Thinning(rate, monotonic)

        def receive(sample: zenoh.Sample) -> None:
            sender = self._sender(sample, "slow")
            if sender is not None and sample.kind == zenoh.SampleKind.PUT and thinning.takes(sender):
                self._receive_message(sender, sample)

        return receive

    def _receive_message(
        self, sender: str, sample: zenoh.Sample, answer: type[Answer | HistoryAnswer] | None = None
    ) -> None:
        size = len(sample.payload) + (0 if sample.attachment is None else len(sample.attachment))
        if size > MAX_BYTES:
            self._refuse(sender, "oversized", f"{size} bytes, more than {MAX_BYTES}")
            return
        # Copies, for the sample would keep the whole buffer in which it came.
        attachment = b"" if sample.attachment is None else sample.attachment.to_bytes()
        message = sample.payload.to_bytes(), attachment
        if answer is not None:
            self._receive(Received(sender, answer(message), size))
        else:
            self._receive(Received(sender, message, size, moving=True))

    def _receive_presence(self, sample: zenoh.Sample) -> None:
        key = str(sample.key_expr)
        found = self._keys.session(key)
        if found is None:
            self._refuse_key(sample)
        elif found[0] != self._keys.link:
            present = sample.kind == zenoh.SampleKind.PUT
            self._note_presence(*found, Presence.JOINED if present else Presence.LEFT, self._keys.robot_of(key))

    def _receive_filter(self, sample: zenoh.Sample) -> None:
        found = self._keys.filter_of(str(sample.key_expr))
        if found is None:
            self._refuse_key(sample)
        elif found[0] != self._keys.link and not self._closed:
            link, name, chunk = found
            present = sample.kind == zenoh.SampleKind.PUT
            try:
                (self._filters.joined if present else self._filters.left)((link, self, name), chunk)
            except ValueError as error:
                self._refuse(link, "filter", str(error))

    def _receive_connection(self, event: zenoh.LinkEvent) -> None:
        if self._note_connection is not None:
            self._note_connection(str(event.link.zid), event.link.src, event.link.dst)

    def _receive_question(self, query: zenoh.Query) -> None:
        payload = b"" if query.payload is None else query.payload.to_bytes()
        if len(payload) != _SINCE.size:
            raise MalformedMessageError("question", f"a question for changes has {len(payload)} bytes")
        # The question may be answered, and its attachment gone, as soon as it is admitted.
        token = None if query.attachment is None else query.attachment.to_bytes()[:MOST_NAMES]
        self._admit(Question(_SINCE.unpack(payload)[0], OpenQuestion(query, "state")))
        if token is not None and self._note_heard is not None:
            self._note_heard(token)

    def _receive_history_question(self, query: zenoh.Query) -> None:
        payload = b"" if query.payload is None else query.payload.to_bytes()
        if not _SECONDS.size <= len(payload) <= _SECONDS.size + _LONGEST_NAME:
            raise MalformedMessageError("question", f"a question for the past has {len(payload)} bytes")
        seconds = _SECONDS.unpack_from(payload)[0]
        if not 0 < seconds <= LONGEST_HISTORY:
            raise MalformedMessageError("question", f"a question for the last {seconds} s")
        after = payload[_SECONDS.size :].decode()
        self._admit(HistoryQuestion(seconds, after, OpenQuestion(query, "history")))

    def _admit(self, question: Question | HistoryQuestion) -> None:
        with self._lock:
            if len(self._questions) >= MOST_QUESTIONS:
                # A peer that means it asks again.
                raise MalformedMessageError("busy", f"{MOST_QUESTIONS} questions wait for answers")
            self._questions.add(question.handle)
        self._receive(Received("", question))

    def _door(self, callback: Callable[[Any], object], end: Callable[[], object] | None = None) -> Any:
        return directly(callback, lambda error: self._receive(refusal(error)), end)

    def _key(self, kind: str, peer: str) -> str:
        return self._keys.of(kind, peer, self._robot_of(peer))

    def _sender(self, sample: zenoh.Sample, kind: str) -> str | None:
        """The peer that a sample is from; None for this link's own, and for a key without an id, which is refused."""
        key = str(sample.key_expr)
        sender = self._keys.sender(key.rpartition("/")[0] if kind == "only" else key, kind)
        if sender is None:
            self._refuse_key(sample)
        return None if sender == self._keys.link else sender

    def _refuse_key(self, sample: zenoh.Sample) -> None:
        key = str(sample.key_expr)
        self._refuse("", "key", f"there is no link's id in its key {key[:_LONGEST_SHOWN_KEY]!r}")

    def _refuse(self, sender: str, reason: str, detail: str) -> None:
        self._receive(Received(sender, MalformedMessageError(reason, detail)))
