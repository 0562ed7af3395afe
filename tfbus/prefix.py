"""Local names on a bus that several robots share: each names its frames as it likes, the bus puts a prefix before."""

from collections.abc import Callable, Iterable
from dataclasses import replace

from tfbus.explanation import Explanation
from tfbus.history import Edge
from tfbus.policy import Policy
from tfbus.stamped import TransformStamped, is_frame, renamed
from tfbus.stamps import Latest
from tfbus.waiting import PendingLookup, Question

Answer = Callable[
    [str, str, int | Latest, int | Latest | None, str | None, int | None, Policy | None], TransformStamped
]
"""`TransformTree.answer`."""


class Prefix:
    """Which name on the bus each local name stands for.

    Parameters
    ----------
    prefix : str
        Put before a name as it is: a slash that is to stand between the two belongs to it, as in ``"robot1/"``.
    shared : iterable of str
        Names that are the same for everybody, such as ``{"map"}``.

    Raises
    ------
    ValueError
        If the prefix, or a shared name, is empty or starts with a slash, or a shared name starts with the prefix: then
        two local names would be one.
    TypeError
        If they are not strings, or `shared` is a single one.
    """

    def __init__(self, prefix: str, shared: Iterable[str] = ()) -> None:
        if isinstance(shared, str):
            raise TypeError(f"shared must be a set of frame names, not the one name {shared!r}")
        self.prefix = prefix
        self.shared = frozenset(shared)
        for name in (prefix, *self.shared):
            if not is_frame(name):
                raise ValueError(f"a prefix or shared name must not be empty or start with '/', got {name!r}")
        for name in self.shared:
            if name.startswith(prefix):
                raise ValueError(f"the shared name {name!r} starts with the prefix {prefix!r}")

    def on_bus(self, name: str) -> str:
        """The name that the bus has for a local one; what cannot name a frame stays, for others to refuse."""
        return name if name in self.shared or not is_frame(name) else self.prefix + name

    def local(self, name: str) -> str:
        """The local name for one on the bus; a frame that has none, being somebody else's, gets a leading slash."""
        if name in self.shared:
            return name
        rest = name.removeprefix(self.prefix)
        return rest if rest != name and is_frame(rest) and rest not in self.shared else f"/{name}"

    def question(self, asked: Question) -> Question:
        """A question with the names of the bus."""
        fixed = None if asked.fixed is None else self.on_bus(asked.fixed)
        return replace(asked, target=self.on_bus(asked.target), source=self.on_bus(asked.source), fixed=fixed)

    def answer(self, found: TransformStamped) -> TransformStamped:
        """An answer with local names."""
        return renamed(found, self.local(found.parent), self.local(found.child))

    def pending(self, found: PendingLookup) -> PendingLookup:
        """A lookup that waits, with the local names that it was asked with; its error has those of the bus."""
        asked = found.question
        fixed = None if asked.fixed is None else self.local(asked.fixed)
        asked = replace(asked, target=self.local(asked.target), source=self.local(asked.source), fixed=fixed)
        return replace(found, question=asked)

    def edge(self, found: Edge) -> Edge:
        """An edge with local names."""
        return replace(found, parent=self.local(found.parent), child=self.local(found.child))

    def explanation(self, found: Explanation, target: str, source: str) -> Explanation:
        """An explanation with local names, in the question as they were asked; its errors have those of the bus."""
        return replace(
            found,
            target=target,
            source=source,
            chain=tuple(map(self.local, found.chain)),
            half_chains=tuple(tuple(map(self.local, half)) for half in found.half_chains),
            edges=tuple(
                replace(edge, parent=self.local(edge.parent), child=self.local(edge.child)) for edge in found.edges
            ),
        )

    def around(self, answer: Answer) -> Answer:
        """`answer`, asked and answering with local names."""

        def answer_locally(
            target: str,
            source: str,
            at: int | Latest,
            source_at: int | Latest | None,
            fixed: str | None,
            not_before: int | None,
            policy: Policy | None,
        ) -> TransformStamped:
            via = None if fixed is None else self.on_bus(fixed)
            found = answer(self.on_bus(target), self.on_bus(source), at, source_at, via, not_before, policy)
            return renamed(found, target, source)

        return answer_locally


def as_prefix(prefix: str | None, shared: Iterable[str]) -> Prefix | None:
    """The arguments `prefix` and `shared` of a broadcaster or a buffer, checked; None without a prefix.

    Raises
    ------
    ValueError, TypeError
        As `Prefix`; and `TypeError` if there are shared names but no prefix that they could do without.
    """
    if prefix is not None:
        return Prefix(prefix, shared)
    if isinstance(shared, str) or tuple(shared):
        raise TypeError(f"shared names need a prefix, got shared={shared!r} alone")
    return None
