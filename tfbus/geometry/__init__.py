"""Rigid transforms, samples that carry frames and a stamp, and arrays of transforms.

The kernel makes the base of a sample: `which_kernel` says which kernel runs. `rows` has the arithmetic on plain tuples, and `transform` the value that users hold. `stamped` adds two frames, a stamp
and an authority; `transform_array` holds many transforms at once; `read_only` protects the arrays of immutable values.
"""

from tfbus.geometry.stamped import TransformStamped
from tfbus.geometry.transform import Transform
from tfbus.geometry.transform_array import TransformArray

__all__ = ["Transform", "TransformArray", "TransformStamped"]
