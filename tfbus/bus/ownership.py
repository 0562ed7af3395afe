"""The right to publish a child: by reservation, or by being its first authority if the policy says so.

A reservation also keeps the place of a frame. Let ``arm`` reserve ``t`` and put it below ``a``. Another authority
cannot publish ``t``, but it can try to put ``a`` below ``t``::

    arm       t below a
    intruder  a below t          the two edges close a loop: the bus has to refuse one

Without reservations the bus refuses the sample that closes the loop. Here it refuses the intruder's edge, whichever
came first:

* the intruder comes second: its sample closes the loop and is refused, as always;
* both are in one batch: `Ownership.intruder` names the intruder's sample, and the bus refuses it;
* the intruder came first, when ``t`` had no parent yet: the bus removes ``a`` when ``arm`` publishes.

If several edges of a loop come from intruders, the edge that was published last is removed first. If the sender of an
edge has reserved its child, the edge stays, and the sample of ``arm`` is refused.
"""

import math
from collections.abc import Mapping
from itertools import pairwise
from typing import Literal, Protocol, get_args

from tfbus.errors import InvalidTransformError
from tfbus.frames import check_frame
from tfbus.geometry.stamped import Batch, TransformStamped
from tfbus.registration import Registration
from tfbus.tree.cycles import NewestEdge

OnConflict = Literal["last", "reject"]


class DatedEdge(NewestEdge, Protocol):
    """The newest edge of one child. `since` is greater for a parent that was published later."""

    @property
    def since(self) -> int: ...


class Ownership:
    """The rights of authorities to publish children.

    Parameters
    ----------
    on_conflict : {"last", "reject"}
        Whether a second authority may publish a child, or only the first, until it is forgotten by `forget`.

    Raises
    ------
    ValueError
        If it is neither.
    """

    def __init__(self, on_conflict: OnConflict) -> None:
        if on_conflict not in get_args(OnConflict):
            raise ValueError(f"on_conflict must be 'last' or 'reject', not {on_conflict!r}")
        self._first_keeps = on_conflict == "reject"
        self._reserved: dict[str, tuple[str, int]] = {}
        self._first: dict[str, str] = {}

    @property
    def restricts(self) -> bool:
        """Whether some sample could be refused."""
        return self._first_keeps or bool(self._reserved)

    @property
    def reserves(self) -> bool:
        """Whether some frame is reserved."""
        return bool(self._reserved)

    def remembers(self, frame: str) -> bool:
        """Whether a frame without an edge is kept for its first authority."""
        return frame in self._first

    def remember(self, known: Mapping[str, NewestEdge]) -> None:
        """Keep moving children for their first authorities across a jump of the clock, if that is the policy.

        It costs one name for each child that was published and not removed.
        """
        if self._first_keeps:
            self._first.update((child, edge.authority) for child, edge in known.items() if not edge.static)

    def forget(self, frame: str) -> None:
        """Let any authority publish a frame that was removed; a reservation stays."""
        self._first.pop(frame, None)

    def reserved_for(self, frame: str) -> str | None:
        """The authority that has reserved a frame, if any."""
        reserved = self._reserved.get(frame)
        return None if reserved is None else reserved[0]

    def reserve(self, frame: str, authority: str) -> Registration:
        """Let only this authority publish a frame, until every registration of it is closed.

        Raises
        ------
        InvalidTransformError
            If the name cannot be the name of a frame, or another authority has reserved it (``reason="reserved"``).
        TypeError
            If `authority` is not a string.
        """
        check_frame(frame)
        if not isinstance(authority, str):
            raise TypeError(f"authority must be a str, not {authority!r}")
        owner, times = self._reserved.get(frame, (authority, 0))
        if owner != authority:
            raise InvalidTransformError(
                f"frame {frame!r} is reserved for {owner!r} and cannot be reserved for {authority!r}",
                reason="reserved",
                child=frame,
                authority=authority,
                owner=owner,
            )
        self._reserved[frame] = (authority, times + 1)
        return Registration(lambda: self._release(frame))

    def split(self, batch: Batch, known: Mapping[str, NewestEdge]) -> tuple[Batch, list[InvalidTransformError]]:
        """The samples of a batch whose authorities may publish them, and the errors of the others, in order."""
        allowed: list[TransformStamped] = []
        refused: list[InvalidTransformError] = []
        new: dict[str, str] = {}
        for sample in batch:
            _, child, _, _, authority, _ = sample._fields
            owner = self.reserved_for(child)
            reason = "authority" if owner is None else "reserved"
            if owner is None and self._first_keeps:
                if child in known:
                    owner = known[child].authority
                else:
                    owner = self._first.get(child)
                    owner = new.setdefault(child, authority) if owner is None else owner
            if owner is None or owner == authority:
                allowed.append(sample)
            else:
                refused.append(_refusal(sample, owner, reason))
        return tuple(allowed), refused

    def intruder(
        self, error: InvalidTransformError, edges: Mapping[str, DatedEdge], batch: Batch
    ) -> InvalidTransformError | None:
        """The error of another authority's edge that keeps a reserved frame from its place.

        Parameters
        ----------
        error : InvalidTransformError
            The error of a sample that closes a loop of parents.
        edges : mapping of child to its newest edge
        batch : tuple of TransformStamped
            The batch that the sample is in.

        Returns
        -------
        InvalidTransformError or None
            Among the edges of the loop by other authorities, the error of the edge that was published last. None if the
            sample itself has to be refused: its frame is not reserved for its sender, or the children of all other
            edges are reserved for their senders.
        """
        frame, owner = error.child, error.authority
        if frame is None or owner is None or self.reserved_for(frame) != owner:
            return None
        found: InvalidTransformError | None = None
        newest = -1.0
        for child, parent in pairwise(error.loop[1:]):
            authority, since = _origin(child, parent, edges, batch)
            if since > newest and authority != owner and self.reserved_for(child) != authority:
                newest = since
                found = InvalidTransformError(
                    f"the edge {parent!r} -> {child!r} from {authority!r} would hang {child!r} below {frame!r}, which "
                    f"{owner!r} has reserved and puts below {child!r}",
                    reason="reserved",
                    parent=parent,
                    child=child,
                    authority=authority,
                    owner=owner,
                )
        return found

    def _release(self, frame: str) -> None:
        authority, times = self._reserved[frame]
        if times > 1:
            self._reserved[frame] = (authority, times - 1)
        else:
            del self._reserved[frame]


def _origin(child: str, parent: str, edges: Mapping[str, DatedEdge], batch: Batch) -> tuple[str, float]:
    """The authority of an edge in a loop, and how late it was published."""
    for sample in reversed(batch):
        if sample.child == child and sample.parent == parent:
            return sample.authority, math.inf
    return edges[child].authority, edges[child].since


def _refusal(sample: TransformStamped, owner: str, reason: str) -> InvalidTransformError:
    why = f"is reserved for {owner!r}" if reason == "reserved" else f"comes from {owner!r}, who was first"
    return InvalidTransformError(
        f"frame {sample.child!r} {why}: no sample of it is taken from {sample.authority!r}",
        reason=reason,
        parent=sample.parent,
        child=sample.child,
        authority=sample.authority,
        owner=owner,
    )
