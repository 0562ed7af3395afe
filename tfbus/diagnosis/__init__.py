"""A doctor for trees of transforms: what in them cannot be right, when, how often, and what to do about it.

`diagnose` examines a `tfbus.TransformTree`; an `Examiner` is fed with samples as they arrive, and so also sees what a
tree does not keep, such as duplicates and stamps that go back.
"""

from tfbus.diagnosis.diagnose import diagnose
from tfbus.diagnosis.examiner import Examiner
from tfbus.diagnosis.finding import Finding
from tfbus.diagnosis.limits import Limits

__all__ = ["Examiner", "Finding", "Limits", "diagnose"]
