"""All frames and their history: a tree answers where one frame was, seen from another, or raises.

No clock, no event loop, no input or output, and nothing of a bus: this room can be used alone, offline.
"""

from tfbus.tree.explanation import ExplainedEdge, Explanation
from tfbus.tree.history import Edge, Outcome
from tfbus.tree.lookup import Hold, Question
from tfbus.tree.tree import TransformTree

__all__ = ["Edge", "ExplainedEdge", "Explanation", "Hold", "Outcome", "Question", "TransformTree"]
