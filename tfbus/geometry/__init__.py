"""Rigid transforms, samples that carry frames and a stamp, and arrays of transforms.

`rows` has the arithmetic on plain tuples, and `transform` the value that users hold. `stamped` adds two frames, a stamp
and an authority; `transform_array` holds many transforms at once; `read_only` protects the arrays of immutable values.
`which_kernel` says whether the compiled kernel runs, which makes the base of a sample, or Python in its place.
"""

from tfbus.geometry.stamped import TransformStamped
from tfbus.geometry.transform import Transform
from tfbus.geometry.transform_array import TransformArray

__all__ = ["Transform", "TransformArray", "TransformStamped"]
