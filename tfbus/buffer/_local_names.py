"""The names of one robot in questions and answers, on a bus that several robots share."""

from collections.abc import Callable
from dataclasses import replace

from tfbus.frames import Prefix
from tfbus.geometry.stamped import TransformStamped, renamed
from tfbus.stamps import Latest
from tfbus.tree.explanation import Explanation
from tfbus.tree.history import Edge
from tfbus.tree.policy import Policy
from tfbus.tree.question import Question
from tfbus.waiting.waiting_index import PendingLookup

Answer = Callable[
    [str, str, int | Latest, int | Latest | None, str | None, int | None, Policy | None], TransformStamped
]
"""`TransformTree.answer`."""


class LocalNames:
    """Translates questions to the names of the bus, and answers back.

    Parameters
    ----------
    prefix : Prefix
    """

    def __init__(self, prefix: Prefix) -> None:
        self._prefix = prefix

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
        """A lookup that waits, with the local names that it was asked with; its error has those of the bus."""
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
        """An explanation with local names, in the question as they were asked; its errors have those of the bus."""
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
            via = None if fixed is None else self._prefix.on_bus(fixed)
            found = answer(
                self._prefix.on_bus(target), self._prefix.on_bus(source), at, source_at, via, not_before, policy
            )
            return renamed(found, target, source)

        return answer_locally
