import copy
import pickle

import pytest

from tfbus import LATEST, SECOND, Hold, Transform, TransformStamped, TransformTree
from tfbus._python_kernel import Sample


def test_the_sample_in_python_reads_its_fields() -> None:
    sample = Sample()
    sample._fields = "a", "b", 5, (3.0, 4.0, 12.0, 0.0, 0.0, 0.0, 1.0), "me", True
    assert (sample.parent, sample.child, sample.stamp, sample.authority, sample.static) == ("a", "b", 5, "me", True)
    assert sample._row == (3.0, 4.0, 12.0, 0.0, 0.0, 0.0, 1.0)
    assert sample._square == 13.0**2


class Marked(TransformStamped):
    """A subclass with something of its own."""


@pytest.mark.parametrize("again", [copy.copy, copy.deepcopy, lambda sample: pickle.loads(pickle.dumps(sample))])
def test_samples_are_copied_and_pickled_with_all_that_they_hold(again: type) -> None:
    sample = Marked("a", "b", 5, Transform((1.0, 2.0, 3.0)), "me", static=True)
    sample.mark = 7  # type: ignore[attr-defined]
    twin = again(sample)
    assert (type(twin), twin, twin.mark) == (Marked, sample, 7)
    tree = TransformTree()
    tree.insert(TransformStamped("a", "b", 0, Transform()))
    held = tree.lookup("a", "b", SECOND, extrapolate=Hold(2.0))
    assert (again(held), again(held).extrapolated_by, again(held).gap) == (held, SECOND, 0)
    assert type(again(tree.lookup("a", "b", LATEST))) is TransformStamped
