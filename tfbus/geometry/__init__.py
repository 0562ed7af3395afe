"""Rigid transforms, samples that carry frames and a stamp, and arrays of transforms.

`transform` has the value that users hold. `stamped` adds two frames, a stamp and an authority; `transform_array` holds
many transforms at once, and protects the arrays of immutable values.
"""

from tfbus.geometry.stamped import TransformStamped
from tfbus.geometry.transform import Transform
from tfbus.geometry.transform_array import TransformArray

__all__ = ["Transform", "TransformArray", "TransformStamped"]
