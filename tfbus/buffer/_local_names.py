"""The local names of one robot, on a bus that several robots share."""

from dataclasses import replace

from tfbus.frames import Prefix
from tfbus.geometry.stamped import TransformStamped, renamed
from tfbus.tree.explanation import Explanation
from tfbus.tree.history import Edge
from tfbus.tree.question import Question
from tfbus.waiting.waiting_index import PendingLookup


class LocalNames:
    """Translates questions into the names of the bus, and answers into local names.

    Parameters
    ----------
    prefix : Prefix
    """

    def __init__(self, prefix: Prefix) -> None:
        self._prefix = prefix

    def on_bus(self, name: str) -> str:
        """The name of a frame on the bus."""
        return self._prefix.on_bus(name)

    def question(self, asked: Question) -> Question:
        """A question with the names of the bus."""
        fixed = None if asked.fixed is None else self._prefix.on_bus(asked.fixed)
        return replace(
            asked, target=self._prefix.on_bus(asked.target), source=self._prefix.on_bus(asked.source), fixed=fixed
        )

    def answer(self, found: TransformStamped) -> TransformStamped:
        """An answer with local names."""
        return renamed(found, self._prefix.local(found.parent), self._prefix.local(found.child))

    def pending(self, found: PendingLookup) -> PendingLookup:
        """A waiting lookup with the local names of its question; its error keeps the names of the bus."""
        asked = found.question
        fixed = None if asked.fixed is None else self._prefix.local(asked.fixed)
        asked = replace(
            asked, target=self._prefix.local(asked.target), source=self._prefix.local(asked.source), fixed=fixed
        )
        return replace(found, question=asked)

    def edge(self, found: Edge) -> Edge:
        """An edge with local names."""
        return replace(found, parent=self._prefix.local(found.parent), child=self._prefix.local(found.child))

    def explanation(self, found: Explanation, target: str, source: str) -> Explanation:
        """An explanation with local names, target and source as asked; its errors keep the names of the bus."""
        return replace(
            found,
            target=target,
            source=source,
            chain=tuple(map(self._prefix.local, found.chain)),
            half_chains=tuple(tuple(map(self._prefix.local, half)) for half in found.half_chains),
            edges=tuple(
                replace(edge, parent=self._prefix.local(edge.parent), child=self._prefix.local(edge.child))
                for edge in found.edges
            ),
        )
