"""A tree that a bus feeds, and lookups that wait for what is still missing."""

from collections.abc import Callable, Iterable
from types import TracebackType
from typing import Any, TypeVar

from tfbus.buffer._local_names import LocalNames
from tfbus.buffer._waiting_lookup import Lookups
from tfbus.buffer.watch import Watch
from tfbus.bus.bus import Bus
from tfbus.data import Stamped, do_transform
from tfbus.errors import TransformLookupError
from tfbus.frames import as_prefix
from tfbus.geometry.stamped import TransformStamped
from tfbus.registration import Registration
from tfbus.stamps import LATEST, Latest
from tfbus.tree.explanation import Explanation
from tfbus.tree.policy import Hold, policy_of
from tfbus.tree.question import Question, question_of
from tfbus.tree.rendering import describe
from tfbus.tree.tree import TransformTree
from tfbus.waiting.live_tree import LiveTree
from tfbus.waiting.waiting_index import PendingLookup

DataT = TypeVar("DataT", bound=Stamped)


class Buffer:
    """A few seconds of every frame on a bus, and the transforms between them.

    Parameters
    ----------
    bus : Bus
        It feeds the buffer from now on, what is latched included, and holds it until `close`.
    keep : float or None
        How much history to keep for each frame, in s before that frame's newest stamp; None keeps everything.
    prefix : str, optional
        What the bus has before the names of this buffer's frames, such as ``"robot1/"``, so that several robots with
        the same frames can share a bus. All methods take and give names without it.
    shared : iterable of str
        Names that have no prefix, because they are the same for everybody, such as ``{"map"}``.
    prefill : Buffer or TransformTree, optional
        Start with a copy of its history, as far as `keep` reaches. If it is a buffer on the same bus, this one then
        answers as if it had been there all along. Otherwise, what is latched on this bus comes on top, and the stamps
        of both have to be of one time: a sample older than the window that it falls into expires as always. What was
        removed after a buffer was closed, that buffer still has.

    Raises
    ------
    BusClosedError
        If the bus is closed.
    ValueError
        If `keep` is negative; if the prefix, or a shared name, is empty or starts with a slash, or a shared name
        starts with the prefix.
    TypeError
        If an argument is of another type, or there are shared names but no prefix.

    Notes
    -----
    What only reads may be used from any thread, at any time; what is awaited, watched or closed, only on the bus's
    event loop.

    With a prefix, another robot's frames have no name here: to ask for them, use a buffer without one. `tree` and all
    errors have the names of the bus; pictures and explanations write a frame that is somebody else's with a slash
    in front.
    """

    def __init__(
        self,
        bus: Bus,
        keep: float | None = 10.0,
        *,
        prefix: str | None = None,
        shared: Iterable[str] = (),
        prefill: "Buffer | TransformTree | None" = None,
    ) -> None:
        self.bus = bus
        self._clock = bus.clock
        named = as_prefix(prefix, shared)
        self._prefix = None if named is None else LocalNames(named)
        self._feed = LiveTree(keep)
        self._room = Lookups(self._feed, bus.clock, bus._check_thread, self._prefix)
        answer = self._feed.tree.answer
        self._answer = answer if self._prefix is None else self._prefix.around(answer)
        if prefill is not None:
            tree = prefill.tree if isinstance(prefill, Buffer) else prefill
            if not isinstance(tree, TransformTree):
                raise TypeError(f"prefill must be a Buffer or a TransformTree, not {prefill!r}")
            bus._check_thread()
            self._feed.prefill(tree)
        bus._attach(self._feed)

    @property
    def tree(self) -> TransformTree:
        """The tree behind this buffer, to read: its samples come from the bus."""
        return self._feed.tree

    def lookup_nowait(
        self,
        target: str,
        source: str,
        at: int | Latest = LATEST,
        *,
        max_age: float | None = None,
        source_at: int | Latest | None = None,
        fixed: str | None = None,
        tolerance: float = 0.0,
        max_gap: float | None = None,
        extrapolate: Hold | None = None,
    ) -> TransformStamped:
        """Where `source` is, seen from `target`, or an error at once. See `TransformTree.lookup`.

        Parameters
        ----------
        target, source : str
        at : int or LATEST
            ns.
        max_age : float, optional
            Count a `LATEST` answer older than this many s as not yet arrived.
        source_at, fixed, tolerance, max_gap, extrapolate
            As `TransformTree.lookup`.

        Raises
        ------
        TransformLookupError, TypeError
            As `TransformTree.lookup`.
        """
        not_before = None if max_age is None else self._room.not_before(max_age, at, source_at)
        policy = None
        if tolerance != 0.0 or max_gap is not None or extrapolate is not None:
            # Not called for nothing, which would cost a twentieth of a lookup.
            policy = policy_of(tolerance, max_gap, extrapolate)
        return self._answer(target, source, at, source_at, fixed, not_before, policy)

    async def lookup(
        self,
        target: str,
        source: str,
        at: int | Latest = LATEST,
        *,
        timeout: float | None = None,
        max_age: float | None = None,
        source_at: int | Latest | None = None,
        fixed: str | None = None,
        tolerance: float = 0.0,
        max_gap: float | None = None,
        extrapolate: Hold | None = None,
    ) -> TransformStamped:
        """Where `source` is, seen from `target`, as soon as that can be answered.

        What can be answered is answered after one checkpoint. What waiting cannot help fails at once: a stamp older
        than an edge's window raises `PastExtrapolationError`. Everything else waits; a frame that nobody ever
        publishes waits for ever, unless there is a timeout, and is logged after 5 s.

        Parameters
        ----------
        target, source : str
        at : int or LATEST
            ns. `LATEST` is the newest stamp that every moving edge on the path can answer.
        timeout : float, optional
            In s on the bus's clock; None waits for ever.
        max_age : float, optional
            Count a `LATEST` answer older than this many s as not yet arrived, so that a dead broadcaster cannot
            answer for ever.
        source_at : int or LATEST, optional
            Take source at this stamp instead, and carry it to `at` through `fixed`.
        fixed : str, optional
            The frame that is held still between the two stamps.
        tolerance, max_gap, extrapolate
            As `TransformTree.lookup`. The wait ends at the first moment at which they allow an answer.

        Returns
        -------
        TransformStamped
            Parent is target and child is source.

        Raises
        ------
        LookupTimeoutError
            If the timeout ran out; its ``__cause__`` says what was still missing.
        PastExtrapolationError
            If it is older than an edge's window.
        GapError
            If it lies in a gap that is too long.
        BusClosedError
            If it cannot be answered and nothing more will come.
        ClockResetError
            If the clock jumped back meanwhile.
        UnknownFrameError
            At once, if a name cannot be that of a frame: empty, or with a leading slash.
        TypeError
            If a stamp is a float, or `max_age` comes without a `LATEST`.
        """
        policy = policy_of(tolerance, max_gap, extrapolate)
        question = Question(target, source, at, source_at, fixed, max_age, policy)
        return await self._room.wait(self._on_bus(question), timeout)

    async def transform(
        self,
        data: DataT,
        target: str,
        *,
        timeout: float | None = None,
        max_age: float | None = None,
        at: int | Latest | None = None,
        fixed: str | None = None,
        tolerance: float = 0.0,
        max_gap: float | None = None,
        extrapolate: Hold | None = None,
    ) -> DataT:
        """`data` in the frame `target`, by the transform of their own stamp, as soon as that has arrived.

        Parameters
        ----------
        data : any type of `tfbus.data` but LaserScan, or a type registered with `do_transform`
            With `frame` and `stamp`; the stamp may be `LATEST`.
        target : str
        timeout, max_age : float, optional
            As `lookup`.
        at : int or LATEST, optional
            Move the data from their own stamp to this one (ns), through `fixed`.
        fixed : str, optional
            The frame that is held still between the two stamps.
        tolerance, max_gap, extrapolate
            As `lookup`. The data do not say what was done; where that matters, look the transform up.

        Returns
        -------
        same type as `data`
            Its frame is `target`, its stamp that of the transform.

        Raises
        ------
        TypeError
            If `data` are of a type that is not registered or has no frame and stamp, or only one of `at` and `fixed`
            is given.
        TransformError
            As `lookup`.
        """
        question = question_of(data, target, at, fixed, max_age, policy_of(tolerance, max_gap, extrapolate))
        moved: DataT = do_transform(data, await self._room.wait(self._on_bus(question), timeout))
        return moved

    def transform_nowait(
        self,
        data: DataT,
        target: str,
        *,
        max_age: float | None = None,
        at: int | Latest | None = None,
        fixed: str | None = None,
        tolerance: float = 0.0,
        max_gap: float | None = None,
        extrapolate: Hold | None = None,
    ) -> DataT:
        """As `transform`, or an error at once.

        Raises
        ------
        TransformLookupError
            As `lookup_nowait`, if there is no answer now.
        TypeError
            As `transform`.
        """
        question = question_of(data, target, at, fixed, max_age, policy_of(tolerance, max_gap, extrapolate))
        moved: DataT = do_transform(data, self._room.ask(self._on_bus(question)))
        return moved

    def can_transform(self, target: str, source: str, at: int | Latest = LATEST, **question: Any) -> bool:
        """Whether `lookup_nowait` with the same arguments has an answer now."""
        try:
            self.lookup_nowait(target, source, at, **question)
        except TransformLookupError:
            return False
        return True

    def watch(
        self,
        target: str,
        source: str,
        *,
        min_translation: float = 0.0,
        min_rotation: float = 0.0,
        max_rate: float | None = None,
        max_age: float | None = None,
        tolerance: float = 0.0,
        max_gap: float | None = None,
        extrapolate: Hold | None = None,
    ) -> Watch:
        """The answer at `LATEST` whenever it has changed: ``with buffer.watch(...) as w: async for transform in w``.

        It starts with the present answer and then compares with the last one that it gave. A slow reader gets what is
        newest when it reads, and nobody is woken by an insertion elsewhere in the tree. While there is no answer it
        waits, as `lookup` does, and goes on with the next one. Of the errors of `lookup` none is raised: at `LATEST`
        nothing is too old or in a gap for good, it only waits for the edge that lags.

        Parameters
        ----------
        target, source : str
        min_translation : float
            Give an answer when source has moved by so many m.
        min_rotation : float
            Give an answer when it has turned by so many rad. With both, either will do; without any, every answer with
            another stamp or value is given.
        max_rate : float, optional
            Give no more than this many answers per s on the bus's clock. Only the last, after the end, may come sooner.
        max_age : float, optional
            Count an answer that is older than this many s as none. It does not end by itself what was given already.
        tolerance, max_gap, extrapolate
            As `lookup`.

        Returns
        -------
        Watch
            It belongs to the buffer until it is closed. When the clock jumps back, it raises `ClockResetError` once and
            starts over; when it, the buffer or the bus is closed, it ends, after what had changed before.

        Raises
        ------
        UnknownFrameError
            If a name cannot be that of a frame: empty, or with a leading slash.
        TypeError, ValueError
            If a threshold is negative or an angle of more than pi, a rate is not greater than zero, or something is not
            a number.
        """
        self.bus._check_thread()
        question = Question(target, source, LATEST, max_age=max_age, policy=policy_of(tolerance, max_gap, extrapolate))
        return Watch(
            self._on_bus(question),
            min_translation,
            min_rotation,
            max_rate,
            self._feed,
            self._room,
            self._clock,
            self.bus._check_thread,
        )

    def explain(
        self,
        target: str,
        source: str,
        at: int | Latest = LATEST,
        *,
        max_age: float | None = None,
        tolerance: float = 0.0,
        max_gap: float | None = None,
        extrapolate: Hold | None = None,
    ) -> Explanation:
        """How `lookup_nowait` with these arguments comes to its answer, or all that keeps it from one.

        See `TransformTree.explain`; ages are counted from the clock's now.
        """
        asked = self._on_bus(Question(target, source, at))
        found = self.tree.explain(
            asked.target,
            asked.source,
            at,
            not_before=None if max_age is None else self._room.not_before(max_age, at, None),
            tolerance=tolerance,
            max_gap=max_gap,
            extrapolate=extrapolate,
            now=self._clock.now(),
        )
        return found if self._prefix is None else self._prefix.explanation(found, target, source)

    def pending(self) -> tuple[PendingLookup, ...]:
        """The lookups that wait now, and the watches without an answer, with what blocks each."""
        pending = self._feed.waiting.pending()
        return pending if self._prefix is None else tuple(map(self._prefix.pending, pending))

    def describe(self) -> str:
        """The tree as text, with each edge's rate, age, span and authority, and the lookups that wait."""
        edges = self.tree.edges()
        if self._prefix is not None:
            edges = sorted(map(self._prefix.edge, edges), key=lambda edge: edge.child)
        lines = [describe(edges, self._clock.now())]
        lines += [f"waiting: {pending}" for pending in self.pending()]
        return "\n".join(lines)

    def on_close(self, callback: Callable[[], object]) -> Registration:
        """Call `callback` once, on the event loop: when this buffer or its bus is closed, or now if one is."""
        return self._feed.on_end(callback)

    def close(self) -> None:
        """Leave the bus; lookups that wait end with `BusClosedError`. What is buffered can still be looked up."""
        self.bus._detach(self._feed)
        self._feed.end("the buffer is closed")
        self._feed.tell_the_end()

    def _on_bus(self, question: Question) -> Question:
        """A question with the names that the bus has."""
        return question if self._prefix is None else self._prefix.question(question)

    def __enter__(self) -> "Buffer":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()
