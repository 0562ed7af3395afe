"""The error of an answer, from the errors of the samples that it was made of.

`correlation` says how the errors of one edge at several stamps are related, `answers` carries them to the answer of a
lookup, and to several answers together. It knows nothing of trees: `tfbus.tree.uncertain` collects what an answer was
made of.
"""

from tfbus.uncertainty.answers import JointAnswers, Share, UncertainTransform, UncertainTransformArray, joint
from tfbus.uncertainty.data import UncertainTwist

__all__ = ["JointAnswers", "Share", "UncertainTransform", "UncertainTransformArray", "UncertainTwist", "joint"]
