"""The newest edges of a bus, and the judgement of each batch before it is committed.

The newest edges must form a forest. The bus judges a batch by them before any buffer gets it, so that the sender learns
of a bad edge at once.
"""

from collections import Counter
from copy import copy
from typing import Literal

from tfbus._log import OnceLogger
from tfbus.bus._announcer import Announcer
from tfbus.bus._ownership import Ownership
from tfbus.errors import InvalidTransformError
from tfbus.events import AuthorityConflict, FrameAdded, FrameRemoved, KindChanged, Reparented, SampleRejected
from tfbus.geometry.stamped import Batch, TransformStamped
from tfbus.registration import Registration
from tfbus.tree.cycles import NewestEdge, admit

_FORMER_PARENTS = 1_000


class _Edge:
    """The newest edge of one child.

    `trusted` is the authority whose moving samples under the same parent need no judgement; None if there is none.
    """

    __slots__ = ("authority", "newest", "parent", "static", "trusted")

    def __init__(self, parent: str, static: bool, authority: str) -> None:
        self.parent = parent
        self.static = static
        self.newest: int | None = None
        self.authority = authority
        self.trusted: str | None = None


class Topology:
    """Each child's newest parent, kind and authority, and the static samples that late joiners need.

    Parameters
    ----------
    log : OnceLogger
    ownership : Ownership
        Says who may publish which child.
    announcer : Announcer
        Announces changes and refusals.

    Attributes
    ----------
    latched : dict of str to TransformStamped
        The static sample of each static child.
    rejected : Counter
        Samples that were refused, by reason.
    reparented, kind_changes, conflicts : int
        Number of samples that gave a child another newest parent, another kind, or another authority than before.
    """

    def __init__(self, log: OnceLogger, ownership: Ownership, announcer: Announcer) -> None:
        self._log = log
        self._ownership = ownership
        self._announcer = announcer
        self._newest: dict[str, _Edge] = {}
        # Every parent of a newest edge, and some that were one.
        self._parents: set[str] = set()
        self.latched: dict[str, TransformStamped] = {}
        self.rejected: Counter[str] = Counter()
        self.reparented = 0
        self.kind_changes = 0
        self.conflicts = 0

    def __len__(self) -> int:
        return len(self._newest)

    def __contains__(self, child: object) -> bool:
        return child in self._newest or (isinstance(child, str) and self._ownership.remembers(child))

    def names(self) -> set[str]:
        """Every frame that an edge names."""
        return {*self._newest, *(known.parent for known in self._newest.values())}

    def newest(self, child: str) -> NewestEdge | None:
        """The newest edge of a child, if it has one."""
        return self._newest.get(child)

    def known(self) -> list[FrameAdded]:
        """An event for each child that has a parent, as if it were new."""
        now = self._announcer.now()
        return [
            FrameAdded(now, child, known.parent, known.authority, known.static) for child, known in self._newest.items()
        ]

    def accept(self, batch: Batch, invalid: Literal["raise", "drop"]) -> Batch:
        """Judge a batch, record the samples that may be committed, and return them.

        Raises
        ------
        InvalidTransformError
            If `invalid` is ``"raise"`` and a sample closes a loop, or its authority may not publish the child; then
            nothing was noted.
        """
        newest = self._newest
        for sample in batch:
            parent, child, _, _, authority, static = sample._fields
            known = newest.get(child)
            if known is None or known.parent != parent or known.trusted != authority or static:
                return self._judge(batch, invalid)
        # Nearly always all samples continue known edges, so that only the stamps are new.
        for sample in batch:
            fields = sample._fields
            known = newest[fields[1]]
            if known.newest is None or fields[2] > known.newest:
                known.newest = fields[2]
        return batch

    def reserve(self, child: str, authority: str) -> Registration:
        """Let only one authority publish a child; see `Ownership.reserve`."""
        registration = self._ownership.reserve(child, authority)
        known = self._newest.get(child)
        if known is not None and known.authority != authority:
            known.trusted = None
        return registration

    def remove(self, child: str) -> None:
        """Forget a child and its first authority."""
        self.latched.pop(child, None)
        self._ownership.forget(child)
        if self._newest.pop(child, None) is not None and self._announcer.has_listeners:
            self._announcer.announce(FrameRemoved(self._announcer.now(), child))

    def clear_moving(self) -> None:
        """Forget every moving child, but keep the right of its first authority."""
        self._ownership.remember({child: known for child, known in self._newest.items() if not known.static})
        self._newest = {child: known for child, known in self._newest.items() if known.static}

    def reject(self, reason: str, error: Exception) -> None:
        """Count and announce a sample that was refused."""
        self.rejected[reason] += 1
        if not self._announcer.has_listeners:
            return
        child = parent = authority = None
        if isinstance(error, InvalidTransformError):
            child, parent, authority = error.child, error.parent, error.authority
        # A copy, because the traceback of the original keeps the sender's variables alive.
        self._announcer.announce(SampleRejected(self._announcer.now(), reason, child, parent, authority, copy(error)))

    def _judge(self, batch: Batch, invalid: Literal["raise", "drop"]) -> Batch:
        refused: list[InvalidTransformError] = []
        if self._ownership.restricts:
            batch, refused = self._ownership.split(batch, self._newest)
        if len(self._parents) > 2 * len(self._newest) + _FORMER_PARENTS:
            self._parents = {known.parent for known in self._newest.values()}
        accepted, looped = admit(self._newest, batch, self._parents)
        refused += looped
        for error in refused:
            self.reject(error.reason, error)
        if refused and invalid == "raise":
            raise refused[0]
        for error in refused:
            self._log.warning((error.reason, error.child, error.authority), "dropped a sample: %s", error)
        for sample in accepted:
            self._parents.add(sample.parent)
            self._record(sample)
        return accepted

    def _record(self, sample: TransformStamped) -> None:
        parent, child, stamp, _, authority, static = sample._fields
        announcer = self._announcer
        known = self._newest.get(child)
        if known is None:
            known = self._newest[child] = _Edge(parent, static, authority)
            if announcer.has_listeners:
                announcer.announce(FrameAdded(announcer.now(), child, parent, authority, static))
        if known.authority != authority:
            if self._ownership.reserved_for(child) is None:
                self._conflict(child, authority, known.authority)
            known.authority = authority
        if known.static != static:
            self.kind_changes += 1
            kind = "static" if static else "moving"
            self._log.warning(("kind", child, authority), "frame %r is now %s, from %r", child, kind, authority)
            known.static = static
            if announcer.has_listeners:
                announcer.announce(KindChanged(announcer.now(), child, static, authority))
        if static or known.newest is None or stamp >= known.newest:
            known.newest = None if static else stamp
            if known.parent != parent:
                self._reparent(child, parent, known.parent, authority)
                known.parent = parent
        known.trusted = None if static else authority
        if static:
            self.latched[child] = sample
        else:
            self.latched.pop(child, None)

    def _conflict(self, child: str, authority: str, other: str) -> None:
        self.conflicts += 1
        first, second = sorted((other, authority))
        key = ("authority", child, first, second)
        self._log.warning(key, "frame %r comes from two authorities, %r and %r", child, first, second)
        if self._announcer.has_listeners:
            self._announcer.announce(AuthorityConflict(self._announcer.now(), child, authority, other))

    def _reparent(self, child: str, parent: str, old_parent: str, authority: str) -> None:
        self.reparented += 1
        key = ("parent", child, authority)
        self._log.info(key, "frame %r moves from %r to %r, says %r", child, old_parent, parent, authority)
        if self._announcer.has_listeners:
            self._announcer.announce(Reparented(self._announcer.now(), child, parent, old_parent, authority))
